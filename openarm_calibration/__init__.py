# SPDX-License-Identifier: Apache-2.0
"""Mounts of the cameras on the robot."""
