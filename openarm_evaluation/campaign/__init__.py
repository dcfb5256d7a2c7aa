# SPDX-License-Identifier: Apache-2.0
"""Many seeded tasks, in one process, several, or through the graph."""
