# SPDX-License-Identifier: Apache-2.0
"""Depth from a pair of cameras: rectification, matching, and pairs of images of one moment."""
