# SPDX-License-Identifier: Apache-2.0
"""Octrees and distance fields: lattice, OctoMap codec, shared distance field."""
