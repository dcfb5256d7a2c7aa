# SPDX-License-Identifier: Apache-2.0
"""Evaluation: campaigns judged by ground truth, the demo, and the network detector's data and training."""
