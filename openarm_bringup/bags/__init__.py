# SPDX-License-Identifier: Apache-2.0
"""Topics to a bag and back, and the numbers that a bag must give."""
