# SPDX-License-Identifier: Apache-2.0
"""The node `move_group`: MoveIt's actions, services and topics, answered by the motion service of this process."""
