# SPDX-License-Identifier: Apache-2.0
"""Requests: what is asked for, its states, what is reported of it, and what outlives it."""
