# SPDX-License-Identifier: Apache-2.0
"""Checks of machine, installation and running graphs."""
