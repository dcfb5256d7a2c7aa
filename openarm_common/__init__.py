# SPDX-License-Identifier: Apache-2.0
"""What the packages of the OpenArm vision suite share: geometry, description, cameras, errors, and the node base."""
