# SPDX-License-Identifier: Apache-2.0
"""Inverse kinematics, collision checks, planning and timing for one arm at a time; the node that plans and executes."""
