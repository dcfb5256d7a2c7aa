# SPDX-License-Identifier: Apache-2.0
"""Strategies: direct grasp, hand-over, push, two objects at once."""
