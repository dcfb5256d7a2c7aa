# SPDX-License-Identifier: Apache-2.0
"""Campaigns through the node graph."""
