# SPDX-License-Identifier: Apache-2.0
"""Synthetic hand-eye problems with a known solution."""
