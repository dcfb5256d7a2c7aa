# SPDX-License-Identifier: Apache-2.0
"""Grasp candidates, places, arm routing."""
