# SPDX-License-Identifier: Apache-2.0
"""Calibration data of other tools and robots: what is read of them, and what is written for them."""
