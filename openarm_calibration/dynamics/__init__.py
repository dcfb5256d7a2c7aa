# SPDX-License-Identifier: Apache-2.0
"""Identification of the servos of an arm: gain, damping, friction, latency."""
