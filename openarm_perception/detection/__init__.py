# SPDX-License-Identifier: Apache-2.0
"""Detection of objects in the image and their localization in the base frame."""
