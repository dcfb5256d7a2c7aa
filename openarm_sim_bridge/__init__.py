# SPDX-License-Identifier: Apache-2.0
"""MuJoCo stand-in for the robot: physics, actuation, cameras, and the node `mujoco_bridge`."""
