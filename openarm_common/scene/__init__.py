# SPDX-License-Identifier: Apache-2.0
"""Scenes: a table and the objects on it."""
