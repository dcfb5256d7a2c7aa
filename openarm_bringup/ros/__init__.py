# SPDX-License-Identifier: Apache-2.0
"""Clients of a running graph: peers, messages of any type, detected objects."""
