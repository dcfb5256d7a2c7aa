# SPDX-License-Identifier: Apache-2.0
"""The surroundings as an octree: occupied, free and unknown cells from depth images, without the robot itself."""
