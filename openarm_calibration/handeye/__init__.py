# SPDX-License-Identifier: Apache-2.0
"""Hand-eye estimation: closed forms, refinement, observability, verdict."""
