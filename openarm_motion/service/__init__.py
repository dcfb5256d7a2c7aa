# SPDX-License-Identifier: Apache-2.0
"""The orchestration of motion: requests in, checked plans and executed motions out; no ROS."""
