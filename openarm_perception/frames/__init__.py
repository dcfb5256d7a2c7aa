# SPDX-License-Identifier: Apache-2.0
"""Frames of depth cameras from files: images with their intrinsics, organised clouds."""
