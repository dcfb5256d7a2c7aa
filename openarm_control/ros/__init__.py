# SPDX-License-Identifier: Apache-2.0
"""The actions and topics of the controllers, and the node `arm_control`."""
