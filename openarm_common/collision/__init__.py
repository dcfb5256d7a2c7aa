# SPDX-License-Identifier: Apache-2.0
"""Shapes of a robot and how far apart they are: for planners, and for who commands motors."""
