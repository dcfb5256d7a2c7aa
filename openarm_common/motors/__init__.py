# SPDX-License-Identifier: Apache-2.0
"""Damiao motors on CAN: frames, registers, buses, and what stands behind them in an emulator."""
