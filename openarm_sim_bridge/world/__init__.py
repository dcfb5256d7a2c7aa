# SPDX-License-Identifier: Apache-2.0
"""The MuJoCo world: from description and scene to a model, stepped tick by tick."""
