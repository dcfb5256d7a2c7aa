# SPDX-License-Identifier: Apache-2.0
"""What may find objects; light enough for a command line to know."""

from __future__ import annotations

from typing import Literal

#: Their colour, a network, both checking each other, a tag on them, or depth alone.
DetectorKind = Literal["color", "network", "both", "tag", "anything"]
