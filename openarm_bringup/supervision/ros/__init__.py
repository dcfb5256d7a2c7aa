# SPDX-License-Identifier: Apache-2.0
"""Readiness of nodes in the ROS graph."""
