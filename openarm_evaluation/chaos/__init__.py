# SPDX-License-Identifier: Apache-2.0
"""A running graph under faults: a seeded schedule, a judge with ground truth."""
