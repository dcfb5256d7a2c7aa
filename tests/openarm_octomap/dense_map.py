# SPDX-License-Identifier: Apache-2.0
"""The map as three dense arrays, in numpy: what blocks are held against. All rays of a scan walk at once."""

from __future__ import annotations

import numpy as np

from openarm_common.octree.lattice import KEY_ZERO, Lattice
from openarm_octomap.config import GridConfig
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN


class DenseMap:
    """Cells of a box; log-odds are 0 where nothing is known."""

    def __init__(self, lattice: Lattice, config: GridConfig) -> None:
        self.lattice, self.config = lattice, config
        # zeros, so that cells that nothing reaches take no memory
        self.known = np.zeros(lattice.shape, bool)
        self.value = np.zeros(lattice.shape, np.float32)
        self.seen = np.zeros(lattice.shape, np.int32)  # ms; not kept without decay

    def states(self, layers: slice = slice(None)) -> np.ndarray:
        return np.where(self.known[layers], np.where(self.value[layers] >= 0.0, OCCUPIED, FREE), UNKNOWN)

    def log_odds(self, layers: slice = slice(None)) -> np.ndarray:
        return np.where(self.known[layers], self.value[layers], np.float32(np.nan))

    def integrate(self, points: np.ndarray, origin: np.ndarray, now: int) -> np.ndarray:
        """Put a cloud into the map; flat indices of the cells whose state changed."""
        ends = np.unique(self.lattice.indices(points.astype(np.float64)), axis=0)
        near = np.ones(len(ends), bool)
        if self.config.max_range >= 0.0:
            near = length(self.centres(ends) - origin)[0] <= self.config.max_range
        hit = near & self.lattice.contains(ends)
        shape = self.lattice.shape
        hits = np.ravel_multi_index(tuple(ends[hit].T), shape)
        misses = np.setdiff1d(self.walk(ends, origin), hits)
        known, value, seen = (a.reshape(-1) for a in (self.known, self.value, self.seen))
        cells = np.concatenate([hits, misses])
        before = np.where(known[cells], np.where(value[cells] >= 0.0, OCCUPIED, FREE), UNKNOWN)
        low, high, up, down = (
            np.float32(v)
            for v in (
                self.config.clamp_min, self.config.clamp_max, self.config.hit_log_odds, self.config.miss_log_odds
            )
        )  # fmt: skip
        value[hits] = np.minimum(value[hits] + up, high)
        value[misses] = np.maximum(value[misses] + down, low)
        known[cells] = True
        if self.config.decay_s > 0.0:
            seen[cells] = now
        return np.sort(cells[before != np.where(value[cells] >= 0.0, OCCUPIED, FREE)])

    def decay(self, limit: int) -> np.ndarray:
        """Forget the occupied cells that were last seen before a moment; their flat indices."""
        old = self.known & (self.value >= 0.0) & (self.seen < limit)
        self.known[old], self.value[old] = False, 0.0
        return np.flatnonzero(old)

    def centres(self, index: np.ndarray) -> np.ndarray:
        return self.lattice.centres(index).astype(np.float32)

    def walk(self, ends: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """Flat indices of the cells that rays go through before their end; liboctomap's arithmetic."""
        edge, key_min = self.lattice.resolution, np.array(self.lattice.key_min)
        at = np.repeat(self.lattice.indices(origin.astype(np.float64))[None], len(ends), axis=0)
        ends, target = ends.copy(), self.centres(ends)
        way, limit = target - origin, self.config.max_range
        far = (length(way)[0] > limit) & (limit >= 0.0)
        target[far] = origin + way[far] / length(way)[1][far, None] * np.float32(limit)
        ends[far] = self.lattice.indices(target[far].astype(np.float64))
        apart = (at != ends).any(axis=1)
        at, ends, target = at[apart], ends[apart], target[apart]
        way = target - origin
        size = length(way)[1]
        way /= size[:, None]
        step = np.sign(way).astype(np.int64)
        with np.errstate(divide="ignore", invalid="ignore"):
            border = (at + key_min - KEY_ZERO + 0.5) * edge + np.float32(step * edge * 0.5).astype(np.float64)
            t = np.where(step != 0, (border - origin.astype(np.float64)) / way.astype(np.float64), np.inf)
            dt = np.where(step != 0, edge / np.abs(way.astype(np.float64)), np.inf)
        through: list[np.ndarray] = []
        while len(at):
            inside = self.lattice.contains(at)
            through.append(np.ravel_multi_index(tuple(at[inside].T), self.lattice.shape))
            # of equal parameters that of z is first, then y
            axis = 2 - np.argmin(t[:, ::-1], axis=1)
            row = np.arange(len(at))
            at[row, axis] += step[row, axis]
            t[row, axis] += dt[row, axis]
            on = (at != ends).any(axis=1) & (t.min(axis=1) <= size)
            at, ends, t, dt, step, size = (a[on] for a in (at, ends, t, dt, step, size))
        return np.unique(np.concatenate(through)) if through else np.empty(0, np.int64)


def length(v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of float32 vectors (n, 3), as float64 and rounded to float32."""
    exact = np.sqrt((v[:, 0] * v[:, 0] + v[:, 1] * v[:, 1] + v[:, 2] * v[:, 2]).astype(np.float64))
    return exact, exact.astype(np.float32)
