# SPDX-License-Identifier: Apache-2.0
"""Altered files and hostile messages, and what the suite makes of them."""
