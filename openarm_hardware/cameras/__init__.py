# SPDX-License-Identifier: Apache-2.0
"""Drivers of cameras: RealSense by its library, any other by OpenCV, and the thread that keeps one open."""
