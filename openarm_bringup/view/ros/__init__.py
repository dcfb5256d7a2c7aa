# SPDX-License-Identifier: Apache-2.0
"""What of a running graph a page shows."""
