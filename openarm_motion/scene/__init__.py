# SPDX-License-Identifier: Apache-2.0
"""The planning scene, attached objects, and the map."""
