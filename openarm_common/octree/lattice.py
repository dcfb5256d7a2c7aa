# SPDX-License-Identifier: Apache-2.0
"""A box of cells on OctoMap's absolute lattice.

Cell `k` of an axis spans ``[(k - 32768) r, (k - 32767) r)`` metres in the frame of the map, whatever box is looked at;
so cells of two maps of one resolution coincide, and the cells of depth d - 1 are pairs of those of depth d. Keys are
0 .. 65535 an axis (depth 16); indices count from the lower corner of the box.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Ints, Mask

#: Levels below the root; a key has as many bits.
DEPTH = 16
#: Key of the cell that begins at 0 m.
KEY_ZERO = 1 << (DEPTH - 1)
#: More cells than this are refused: 1 GB for a distance of each.
MAX_CELLS = 1 << 28

Triple = tuple[int, int, int]


@dataclass(frozen=True)
class Lattice:
    """Which cells an array represents.

    Attributes:
        resolution: Edge of a cell, m.
        key_min: Key of cell (0, 0, 0).
        shape: Number of cells along x, y, z.
    """

    resolution: float
    key_min: Triple
    shape: Triple

    @classmethod
    def from_bounds(cls, resolution: float, lower: Sequence[float], upper: Sequence[float], align: int = 1) -> Lattice:
        """Return the smallest box of whole cells that contains two corners.

        Args:
            resolution: Edge of a cell, m.
            lower: Corner (3,), m.
            upper: Opposite corner (3,), m.
            align: Keys of the faces are multiples of this (a power of two lets coarser cells fit in whole).

        Raises:
            OpenArmError: CONFIG_INVALID, when the box is empty, leaves the 65536 keys or has too many cells.
        """
        if not resolution > 0.0 or not all(math.isfinite(v) for v in (*lower, *upper)):
            raise OpenArmError(Code.CONFIG_INVALID, f"resolution {resolution}, corners {lower}, {upper}: not finite")
        # the tolerance keeps a face that lies on the lattice from being moved outwards by rounding
        first = [_floor_to(math.floor(v / resolution + 1e-6) + KEY_ZERO, align) for v in lower]
        last = [-_floor_to(-(math.ceil(v / resolution - 1e-6) + KEY_ZERO), align) for v in upper]
        shape = [b - a for a, b in zip(first, last, strict=True)]
        if min(shape) <= 0 or min(first) < 0 or max(last) > 2 * KEY_ZERO or math.prod(shape) > MAX_CELLS:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"box {tuple(lower)} .. {tuple(upper)} m has {shape} cells of {resolution} m; expected at least one"
                f" along each axis, at most {MAX_CELLS} together, within ±{KEY_ZERO * resolution:g} m",
            )
        return cls(resolution, (first[0], first[1], first[2]), (shape[0], shape[1], shape[2]))

    @property
    def lower(self) -> Array:
        """Lower corner (3,), m."""
        return np.asarray((np.array(self.key_min) - KEY_ZERO) * self.resolution, np.float64)

    @property
    def upper(self) -> Array:
        """Upper corner (3,), m."""
        return self.lower + np.array(self.shape) * self.resolution

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return math.prod(self.shape)

    def centres(self, indices: ArrayLike) -> Array:
        """Return the centres (..., 3), m, of cell indices (..., 3)."""
        keys = np.asarray(indices, dtype=np.int64) + np.array(self.key_min)
        return np.asarray((keys - KEY_ZERO + 0.5) * self.resolution, np.float64)

    def indices(self, points: ArrayLike) -> Ints:
        """Return the indices (..., 3) of the cells that contain points (..., 3), m; may lie outside of the box."""
        p = np.asarray(points, dtype=np.float64)
        return np.floor(p * (1.0 / self.resolution)).astype(np.int64) + (KEY_ZERO - np.array(self.key_min))

    def contains(self, indices: ArrayLike) -> Mask:
        """Whether indices (..., 3) lie in the box."""
        i = np.asarray(indices)
        return np.asarray(((i >= 0) & (i < np.array(self.shape))).all(axis=-1))

    def range_of(self, lower: ArrayLike, upper: ArrayLike) -> tuple[slice, slice, slice]:
        """Return the slices of the cells that a box (two corners, m) touches, cut to this box."""
        first = np.clip(self.indices(lower), 0, self.shape)
        last = np.clip(self.indices(upper) + 1, 0, self.shape)
        x, y, z = (slice(int(a), int(b)) for a, b in zip(first, last, strict=True))
        return x, y, z

    def coarser(self, levels: int) -> Lattice:
        """Return the box of cells 2 ** `levels` as large that covers this one.

        Raises:
            OpenArmError: INVALID_ARGUMENT, unless 0 <= levels < 16.
        """
        if not 0 <= levels < DEPTH:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"levels is {levels}; expected 0 .. {DEPTH - 1}")
        first = [k >> levels for k in self.key_min]
        last = [(k + n - 1) >> levels for k, n in zip(self.key_min, self.shape, strict=True)]
        # cell 0 m keeps its key: keys of a map carry no depth
        shift = KEY_ZERO - (KEY_ZERO >> levels)
        x, y, z = (k + shift for k in first)
        nx, ny, nz = (b - a + 1 for a, b in zip(first, last, strict=True))
        return Lattice(self.resolution * 2**levels, (x, y, z), (nx, ny, nz))


def _floor_to(value: int, step: int) -> int:
    return value // step * step
