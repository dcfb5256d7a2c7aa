# SPDX-License-Identifier: Apache-2.0
"""Planning of one arm or both."""
