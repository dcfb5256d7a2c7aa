# SPDX-License-Identifier: Apache-2.0
"""The robot: its description, where its frames are at a stamp, and which pixels and points belong to it."""
