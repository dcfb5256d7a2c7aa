# SPDX-License-Identifier: Apache-2.0
"""Grasps of things of any shape: the surface that cameras see, the shape of the hand, and samplers by name."""
