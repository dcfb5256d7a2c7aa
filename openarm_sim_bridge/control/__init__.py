# SPDX-License-Identifier: Apache-2.0
"""Controllers of arms and grippers, as ros2_controllers run them."""
