# SPDX-License-Identifier: Apache-2.0
"""Faults and requests on a running graph."""
