# SPDX-License-Identifier: Apache-2.0
"""What every node starts from: parameters, QoS, diagnostics, lifecycle, message conversion, frames."""
