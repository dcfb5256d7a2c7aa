# SPDX-License-Identifier: Apache-2.0
"""The nodes `calibration` and `calibration_publisher`, and their client."""
