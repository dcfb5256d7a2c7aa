# SPDX-License-Identifier: Apache-2.0
"""One grasp, observed and judged by ground truth; statistics and provenance for reports."""
