# SPDX-License-Identifier: Apache-2.0
"""Rendering of the cameras in a process of its own."""
