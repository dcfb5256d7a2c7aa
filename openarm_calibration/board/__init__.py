# SPDX-License-Identifier: Apache-2.0
"""Calibration boards: definition, files to print, detection in an image."""
