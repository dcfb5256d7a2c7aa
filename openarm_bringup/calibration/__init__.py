# SPDX-License-Identifier: Apache-2.0
"""Calibration runs of the simulated robot, and samples from bags."""
