# SPDX-License-Identifier: Apache-2.0
"""Calibration samples and scenes of a running graph."""
