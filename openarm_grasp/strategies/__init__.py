# SPDX-License-Identifier: Apache-2.0
"""How objects are picked and placed: straight async functions, listed in `registry`."""
