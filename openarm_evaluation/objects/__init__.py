# SPDX-License-Identifier: Apache-2.0
"""The suite's own objects: household shapes made from parameters, written as folders, and pictures of them."""
