# SPDX-License-Identifier: Apache-2.0
"""Objects of any shape: folders of meshes, superquadrics, their convex parts, and the sides that they rest on."""
