# SPDX-License-Identifier: Apache-2.0
"""The node `motion` and its client."""
