# SPDX-License-Identifier: Apache-2.0
"""Constraints of an arm's configurations, as regions: goals that lie in them, and paths that stay in them."""
