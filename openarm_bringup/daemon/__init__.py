# SPDX-License-Identifier: Apache-2.0
"""The daemon of a graph: it stays in the graph and runs commands for the command line, which then answers at once."""
