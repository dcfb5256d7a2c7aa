# SPDX-License-Identifier: Apache-2.0
"""Robot folders: drafts from MJCF or URDF, the SRDF with its sampled collision matrix, and checks of all of it."""
