# SPDX-License-Identifier: Apache-2.0
"""Training of the network detector; needs torch (extra `train`), which nothing else in the suite imports."""
