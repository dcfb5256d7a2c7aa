# SPDX-License-Identifier: Apache-2.0
"""Stored calibrations."""
