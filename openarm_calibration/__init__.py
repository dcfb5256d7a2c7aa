# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration of the cameras, and their mounts on the robot."""
