# SPDX-License-Identifier: Apache-2.0
"""Processes and the command line: which nodes run, how they start and stop, and what a user types."""
