# SPDX-License-Identifier: Apache-2.0
"""Detections, and one object that can be trusted among them."""
