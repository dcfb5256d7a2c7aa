# SPDX-License-Identifier: Apache-2.0
"""Things on a table in depth images, without colours and classes: clusters, their shapes, and those of two views."""
