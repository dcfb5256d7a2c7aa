# SPDX-License-Identifier: Apache-2.0
"""The nodes `mujoco_bridge` and `mujoco_cameras`."""
