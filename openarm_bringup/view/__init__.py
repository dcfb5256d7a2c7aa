# SPDX-License-Identifier: Apache-2.0
"""Visualisation of a graph: the web page, and Foxglove."""
