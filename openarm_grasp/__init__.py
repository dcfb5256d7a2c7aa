# SPDX-License-Identifier: Apache-2.0
"""Vision-guided grasping: candidates, arm routing, state machine, evidence, and the node and client around them."""
