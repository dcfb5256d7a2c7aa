# SPDX-License-Identifier: Apache-2.0
"""Observation of a running graph for the judge."""
