# SPDX-License-Identifier: Apache-2.0
"""Data for the network detector, and what a running detector sees."""
