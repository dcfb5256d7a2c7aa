# SPDX-License-Identifier: Apache-2.0
"""Graphs as data, and their processes: started in the order of their needs, watched, restarted, stopped."""
