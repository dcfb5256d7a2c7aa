# SPDX-License-Identifier: Apache-2.0
"""Collision checks: exact and fast layers, shapes, and the occupancy map."""
