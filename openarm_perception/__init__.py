# SPDX-License-Identifier: Apache-2.0
"""From colour and depth images to clouds and to objects in the base frame."""
