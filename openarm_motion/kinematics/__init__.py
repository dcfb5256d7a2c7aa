# SPDX-License-Identifier: Apache-2.0
"""Forward and inverse kinematics of serial arms."""
