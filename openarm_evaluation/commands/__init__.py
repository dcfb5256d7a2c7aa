# SPDX-License-Identifier: Apache-2.0
"""Commands of the command line that evaluate: demo, campaign, chaos, detector, objects."""
