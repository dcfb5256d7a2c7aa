# SPDX-License-Identifier: Apache-2.0
"""Time parameterization and validation of trajectories."""
