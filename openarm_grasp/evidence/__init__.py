# SPDX-License-Identifier: Apache-2.0
"""Evidence: what gripper and cameras say about a grasp."""
