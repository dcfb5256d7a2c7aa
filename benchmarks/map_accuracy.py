# SPDX-License-Identifier: Apache-2.0
"""Accuracy of a map: cells compared with the geometry that a simulator knows.

Nothing that controls the robot reads it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, generate_binary_structure

from openarm_common.types import Bytes
from openarm_octomap.kernels import OCCUPIED

Cells = NDArray[np.bool_]


@dataclass(frozen=True)
class MapAccuracy:
    """A map against the truth.

    Attributes:
        occupied: Occupied cells of the map.
        surface: Cells that have a surface which a camera sees.
        iou: Cells in both over cells in one of them, where a cell next to the other's counts as in both: a surface on
            the border of two cells belongs to either.
        iou_strict: The same without that tolerance.
        ghosts: Occupied cells with nothing solid in them or next to them.
        missed: Cells of visible surfaces with nothing occupied in them or next to them.
    """

    occupied: int
    surface: int
    iou: float
    iou_strict: float
    ghosts: int
    missed: int


def compare(states: Bytes, surface: Cells, solid: Cells) -> MapAccuracy:
    """Judge a map.

    Args:
        states: (nx, ny, nz) of the map.
        surface: Cells that have a surface which a camera sees.
        solid: Cells that have something solid, seen or not.
    """
    occupied = states == OCCUPIED
    neighbours = generate_binary_structure(3, 3)
    ghosts = occupied & np.logical_not(binary_dilation(solid, neighbours))
    missed = surface & np.logical_not(binary_dilation(occupied, neighbours))
    hits, found = int(occupied.sum() - ghosts.sum()), int(surface.sum() - missed.sum())
    union = int(ghosts.sum()) + int(missed.sum()) + max(hits, found)
    strict = int((occupied | surface).sum())
    return MapAccuracy(
        occupied=int(occupied.sum()),
        surface=int(surface.sum()),
        iou=max(hits, found) / union if union else 1.0,
        iou_strict=int((occupied & surface).sum()) / strict if strict else 1.0,
        ghosts=int(ghosts.sum()),
        missed=int(missed.sum()),
    )
