# SPDX-License-Identifier: Apache-2.0
"""What a person sees of a graph: the web page, and Foxglove."""
