# SPDX-License-Identifier: Apache-2.0
"""The map: a bounded box of cells with log-odds, fed with scans.

`OccupancyGrid` is the one mutable object of the package. Coordinates are in the base frame, m. Cells are dense arrays:
a workspace of 2 × 2 × 1.5 m at 2 cm is 3 MB, and no tree is walked to update it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import Leaves, OctreeEncoder, Payload
from openarm_common.octree.lattice import DEPTH, Lattice
from openarm_common.robot.self_filter import Shapes
from openarm_common.types import Array, Bytes, Floats
from openarm_octomap import kernels
from openarm_octomap.config import GridConfig
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN, reset_cells

#: Keys outside of the box that one scan may end in.
_TABLE = 1 << 20


@dataclass(frozen=True, eq=False)
class DepthScan(DepthView):
    """A depth image and where it was taken.

    Attributes:
        label: (h, w): 0 environment, 1 robot, 2 not known; None: all environment.
    """

    label: Bytes | None = None

    def points(self) -> Floats:
        """Points (n, 3) float32 of the valid pixels in the base frame, m: exactly those that are put into the map."""
        depth = self.depth.astype(np.float32) * self.scale
        v, u = np.nonzero((depth >= np.float32(self.near)) & (depth <= np.float32(self.far)))
        a, b, z = self.rays[0][u], self.rays[1][v], depth[v, u]
        # in the order in which the kernel computes, so that they are equal to the last bit
        rows = self.T_base_camera[:3].astype(np.float32)
        return np.stack([(row[0] * a + (row[1] * b + row[2])) * z + row[3] for row in rows], axis=1)


@dataclass(frozen=True, eq=False)
class CloudScan:
    """Points (n, 3) float32 in the base frame, m, the origin (3,) of their rays, and labels (n,) as for an image."""

    points: Floats
    origin: Array
    label: Bytes | None = None


@dataclass(frozen=True)
class Update:
    """What an update did.

    Attributes:
        ends: Cells that rays ended in.
        valid: Pixels or points that were valid.
        cleared: Rays without a return that cleared.
        changed: Flat indices of the cells whose state changed.
    """

    ends: int
    valid: int
    cleared: int
    changed: NDArray[np.int32]


class OccupancyGrid:
    """Cells of a workspace; NaN log-odds are unknown.

    Args:
        config: Workspace, resolution and how fast cells change their state.
    """

    def __init__(self, config: GridConfig) -> None:
        self.config = config
        # eight cells: whole coarse cells at three further depths, and rows of whole words
        self.lattice = Lattice.from_bounds(config.resolution, config.lower, config.upper, align=8)
        shape = self.lattice.shape
        self.log_odds: Floats = np.full(shape, np.nan, np.float32)
        self.states: Bytes = np.zeros(shape, np.uint8)
        self.seen: NDArray[np.int32] = np.zeros(shape, np.int32)  # ms of the newest observation
        self._marks = np.zeros(shape, np.uint8)
        self._ticks = np.zeros(shape, np.uint16)
        self._tick = 0
        self._table = np.full(_TABLE, -1, np.int64)
        self._ends = np.empty((0, 3), np.int32)
        self._changed = np.empty(self.lattice.cells, np.int32)
        self._key_min = np.array(self.lattice.key_min, np.int64)
        self._encoder = OctreeEncoder(self.lattice)
        self._epoch_ns: int | None = None

    def integrate(self, scans: Sequence[DepthScan | CloudScan], t_ns: int) -> Update:
        """Put scans of one moment into the map; a cell that any of them hit counts as hit.

        Args:
            scans: Images or clouds.
            t_ns: Their stamp.
        """
        counts = np.array([self._mark(scan) for scan in scans], np.int64).reshape(-1, 3)
        ends, valid, cleared = counts.sum(axis=0).tolist()
        return Update(ends, valid, cleared, self._apply(self._milliseconds(t_ns)))

    def decay(self, t_ns: int) -> NDArray[np.int32]:
        """Make occupied cells unknown that were not observed for `decay_s`; flat indices of those."""
        if self.config.decay_s <= 0.0:
            return np.empty(0, np.int32)
        limit = self._milliseconds(t_ns) - round(self.config.decay_s * 1e3)
        old = (self.states == OCCUPIED) & (self.seen < limit)
        self.states[old], self.log_odds[old] = UNKNOWN, np.nan
        return np.flatnonzero(old).astype(np.int32)

    def forget(self, shapes: Shapes, padding: float) -> NDArray[np.int32]:
        """Make the occupied cells unknown that padded shapes fill; flat indices of those.

        Args:
            shapes: The robot, base frame.
            padding: In place of that of the shapes, m.
        """
        n = reset_cells(
            shapes.kinds, shapes.halves + padding, shapes.seen_from(np.eye(4)),
            self.lattice.resolution, self._key_min, self.log_odds, self.states, self._changed,
        )  # fmt: skip
        return self._changed[:n].copy()

    def oldest_s(self, t_ns: int) -> float:
        """Return the seconds since the occupied cell was observed that has waited longest; 0 without occupied cells."""
        seen = self.seen[self.states == OCCUPIED]
        if not seen.size or self._epoch_ns is None:
            return 0.0
        return max(0.0, (t_ns - self._epoch_ns) * 1e-9 - float(seen.min()) * 1e-3)

    def counts(self) -> dict[str, int]:
        """Return how many cells are occupied, free and unknown."""
        number = np.bincount(self.states.reshape(-1), minlength=3)
        return {"occupied": int(number[OCCUPIED]), "free": int(number[FREE]), "unknown": int(number[UNKNOWN])}

    def reset(self) -> None:
        """Forget everything."""
        self.log_odds[...] = np.nan
        self.states[...] = UNKNOWN
        self.seen[...] = 0

    def clear_box(self, lower: ArrayLike, upper: ArrayLike, state: int = FREE) -> int:
        """Make the cells that a box touches free, or unknown.

        Args:
            lower: Corner (3,), m.
            upper: Opposite corner (3,), m.
            state: FREE or UNKNOWN.

        Returns:
            How many cells are set.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the corners are not finite or not in order.
        """
        a, b = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
        if not (np.isfinite(a).all() and np.isfinite(b).all() and (a <= b).all()):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"box {a.tolist()} .. {b.tolist()}: expected finite corners, the lower one first"
            )
        box = self.lattice.range_of(a, b)
        self.log_odds[box] = self.config.clamp_min if state == FREE else np.nan
        self.states[box] = FREE if state == FREE else UNKNOWN
        return int(self.states[box].size)

    def load(self, leaves: Leaves) -> int:
        """Replace the map; log-odds are cut to the limits of this map.

        Returns:
            How many leaves lie outside of the workspace, wholly or in part.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the resolutions differ; the map is as it was.
        """
        values, outside = leaves.on(self.lattice)
        self.log_odds[...] = np.clip(values, self.config.clamp_min, self.config.clamp_max)
        known = np.isfinite(self.log_odds)
        self.states[...] = np.where(known, np.where(self.log_odds >= 0.0, OCCUPIED, FREE), UNKNOWN)
        self.seen[...] = 0
        return outside

    def binary(self) -> Payload:
        """Return the map as OctoMap's binary form."""
        return self._encoder.binary(self.states)

    def full(self) -> Payload:
        """Return the map as OctoMap's full form."""
        return self._encoder.full(self.log_odds)

    def coarse(self, depth: int) -> tuple[Lattice, Bytes]:
        """States at another depth of the tree: a cell is occupied when any of its parts is, free when any is free.

        Args:
            depth: 1 to 16, the resolution of the map; each level less doubles the edge.

        Returns:
            The box of coarse cells and their states.
        """
        states = self.states
        for level in range(DEPTH - depth):
            finer = self.lattice.coarser(level)
            pads = [(k % 2, (k + n) % 2) for k, n in zip(finer.key_min, finer.shape, strict=True)]
            padded = np.pad(states, pads) if any(map(any, pads)) else states
            nx, ny, nz = (n // 2 for n in padded.shape)
            # UNKNOWN < FREE < OCCUPIED: the largest state is the careful one
            states = padded.reshape(nx, 2, ny, 2, nz, 2).max(axis=(1, 3, 5))
        return self.lattice.coarser(DEPTH - depth), states

    def states_at(self, points: ArrayLike, depth: int = DEPTH) -> Bytes:
        """Return states (n,) of the cells that contain points (n, 3), m; UNKNOWN outside of the workspace."""
        lattice, states = self.coarse(depth)
        index = lattice.indices(np.asarray(points, np.float64).reshape(-1, 3))
        inside = lattice.contains(index)
        out = np.full(index.shape[0], UNKNOWN, np.uint8)
        out[inside] = states[tuple(index[inside].T)]
        return out

    def _mark(self, scan: DepthScan | CloudScan) -> tuple[int, int, int]:
        config = self.config
        self._tick += 1
        if self._tick > 65535:
            self._ticks[...] = 0
            self._tick = 1
        size = scan.depth.size if isinstance(scan, DepthScan) else scan.points.shape[0]
        if self._ends.shape[0] < size:
            self._ends = np.empty((size, 3), np.int32)
        kept = (self._marks, self._ticks, self._tick, self._table, self._ends)
        if isinstance(scan, DepthScan):
            origin = scan.T_base_camera[:3, 3].astype(np.float32)
            label = np.zeros(scan.depth.shape, np.uint8) if scan.label is None else scan.label
            ends, valid, cleared = kernels.image_ends(
                scan.depth, scan.scale, np.float32(scan.near), np.float32(scan.far),
                config.no_return_block if config.clear_without_return else 0, self._stride(scan.intrinsics),
                np.float32(config.no_return_range),
                *scan.rays, np.ascontiguousarray(scan.T_base_camera[:3], dtype=np.float32), label,
                config.resolution, self._key_min, origin, config.max_range, *kept,
            )  # fmt: skip
        else:
            origin, cleared = scan.origin.astype(np.float32), 0
            label = np.zeros(size, np.uint8) if scan.label is None else scan.label
            ends, valid = kernels.cloud_ends(
                scan.points, label, config.resolution, self._key_min, origin, config.max_range, *kept
            )
        kernels.walk_rays(self._ends, ends, config.resolution, self._key_min, origin, config.max_range, self._marks)
        return ends, valid, cleared

    def _apply(self, now: int) -> NDArray[np.int32]:
        config = self.config
        flat = self._marks.reshape(-1), self.log_odds.reshape(-1), self.states.reshape(-1), self.seen.reshape(-1)
        numbers = (config.hit_log_odds, config.miss_log_odds, config.clamp_min, config.clamp_max)
        hit, miss, low, high = (np.float32(v) for v in numbers)
        n = kernels.apply_marks(*flat, now, hit, miss, low, high, self._changed)
        return self._changed[:n].copy()

    def _stride(self, intrinsics: Intrinsics) -> int:
        """Pixels between rays that clear without a return: no cell within their range is left out between two."""
        pixels = self.config.resolution * min(intrinsics.fx, intrinsics.fy) / self.config.no_return_range
        return max(1, min(int(pixels), self.config.no_return_block))

    def _milliseconds(self, t_ns: int) -> int:
        """Return the time since the first scan; a clock that was set back begins again."""
        if self._epoch_ns is None or t_ns < self._epoch_ns:
            self._epoch_ns = t_ns
            self.seen[...] = 0
        return (t_ns - self._epoch_ns) // 1_000_000
