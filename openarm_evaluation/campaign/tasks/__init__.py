# SPDX-License-Identifier: Apache-2.0
"""Tasks of campaigns, by suite and seed."""
