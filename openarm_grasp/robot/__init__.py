# SPDX-License-Identifier: Apache-2.0
"""What the strategies need of a robot: an interface, and the skills that are built on it."""
