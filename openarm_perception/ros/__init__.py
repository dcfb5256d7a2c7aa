# SPDX-License-Identifier: Apache-2.0
"""The nodes `cloud` and `detector`."""
