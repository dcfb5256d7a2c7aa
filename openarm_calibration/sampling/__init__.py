# SPDX-License-Identifier: Apache-2.0
"""Calibration samples: sessions, synchronization, and the next best pose."""
