# SPDX-License-Identifier: Apache-2.0
"""One grasp, watched and judged by ground truth, with what a report says beside it."""
