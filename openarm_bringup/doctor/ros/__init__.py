# SPDX-License-Identifier: Apache-2.0
"""Listening to a running graph."""
