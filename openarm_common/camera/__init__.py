# SPDX-License-Identifier: Apache-2.0
"""Cameras: mounts, intrinsics, housings, depth images with their pose."""
