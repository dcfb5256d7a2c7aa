# SPDX-License-Identifier: Apache-2.0
"""Servoing: arms that follow twists and joint velocities, and always have a stop that keeps clear."""
