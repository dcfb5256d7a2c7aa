# SPDX-License-Identifier: Apache-2.0
"""The map: a bounded box of cells with log-odds, fed with scans.

`OccupancyGrid` is the one mutable object of the package. Coordinates are in the base frame, m. Cells are in blocks that
take memory where something was seen (`openarm_common.octree.blocks`), and what a scan marks are bits: the cells
of a workspace of 2 × 2 × 1.5 m at 2 cm take 1 MB, and no tree is walked to update it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.block_kernels import CELLS
from openarm_common.octree.blocks import CellSet, VoxelBlocks, empty_rows, more_rows
from openarm_common.octree.codec import Leaves, Payload, encode_binary, encode_full
from openarm_common.octree.lattice import DEPTH, Lattice
from openarm_common.robot.self_filter import Shapes
from openarm_common.types import Array, Bytes, Floats, Ints
from openarm_octomap import cell_kernels, kernels
from openarm_octomap.config import GridConfig
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN

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
        changed: Cells whose state changed.
    """

    ends: int
    valid: int
    cleared: int
    changed: CellSet


class OccupancyGrid:
    """Cells of a workspace.

    Args:
        config: Workspace, resolution and how fast cells change their state.
    """

    def __init__(self, config: GridConfig) -> None:
        self.config = config
        # whole blocks, and so whole coarse cells at three further depths
        self.lattice = Lattice.from_bounds(config.resolution, config.lower, config.upper, align=8)
        self.blocks = VoxelBlocks(self.lattice)
        number = self.lattice.cells // CELLS
        self._never_seen()
        self._through, self._hits, self._ended = (np.zeros((number, CELLS // 64), np.uint64) for _ in range(3))
        self._table = np.full(_TABLE, -1, np.int64)
        self._ends = np.empty((0, 3), np.int32)
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

    def decay(self, t_ns: int) -> CellSet:
        """Make occupied cells unknown that were not observed for `decay_s`; returns those."""
        changed, blocks = self.blocks.cell_set(), self.blocks
        if self.config.decay_s > 0.0:
            limit = self._milliseconds(t_ns) - round(self.config.decay_s * 1e3)
            blocks.repeat(
                lambda: cell_kernels.forget_unseen(blocks.rows, blocks.palette, self._seen, limit, changed.words)
            )
        return changed

    def forget(self, shapes: Shapes, padding: float) -> CellSet:
        """Make the occupied cells unknown that padded shapes fill; returns those.

        Args:
            shapes: The robot, base frame.
            padding: Padding in place of that of the shapes, m.
        """
        changed, blocks = self.blocks.cell_set(), self.blocks
        where = (shapes.kinds, shapes.halves + padding, shapes.seen_from(np.eye(4)), self.lattice.resolution)
        blocks.repeat(
            lambda: cell_kernels.forget_shapes(
                *where, blocks.key_min, blocks.shape, blocks.rows, blocks.palette, changed.words
            )
        )
        return changed

    def oldest_s(self, t_ns: int) -> float:
        """Return the seconds since the occupied cell was observed that has waited longest; 0 without occupied cells."""
        counts, oldest = self._tally()
        if counts[OCCUPIED] == 0 or self._epoch_ns is None:
            return 0.0
        return max(0.0, (t_ns - self._epoch_ns) * 1e-9 - oldest * 1e-3)

    def counts(self) -> dict[str, int]:
        """Return how many cells are occupied, free and unknown."""
        number = self._tally()[0]
        return {"occupied": int(number[OCCUPIED]), "free": int(number[FREE]), "unknown": int(number[UNKNOWN])}

    @property
    def nbytes(self) -> int:
        """Memory that the map takes, bytes."""
        marks = (self._through, self._hits, self._ended, self._table, self._ends)
        return self.blocks.nbytes + sum(array.nbytes for array in (*self._seen, *marks))

    def reset(self) -> None:
        """Forget everything."""
        self.blocks.clear()
        self._never_seen()

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
        self.blocks.fill(box, self.config.clamp_min if state == FREE else np.nan)
        return math.prod(s.stop - s.start for s in box)

    def load(self, leaves: Leaves, T_base_tree: Array | None = None) -> int:
        """Replace the map; log-odds are cut to the limits of this map.

        Args:
            leaves: A tree of cells of any size.
            T_base_tree: (4, 4) its frame in the base frame; None: it is the base frame.

        Returns:
            How many leaves lie outside of the workspace, wholly or in part.
        """
        outside = leaves.put(self.blocks, self.config.clamp_min, self.config.clamp_max, T_base_tree)
        self._never_seen()
        return outside

    def binary(self) -> Payload:
        """Return the map as OctoMap's binary form."""
        return encode_binary(self.blocks)

    def full(self) -> Payload:
        """Return the map as OctoMap's full form."""
        return encode_full(self.blocks)

    def coarse(self, depth: int) -> tuple[Lattice, Bytes]:
        """States at another depth of the tree: a cell is occupied when any of its parts is, free when any is free.

        Args:
            depth: 1 to 16, the resolution of the map; each level less doubles the edge.

        Returns:
            The box of coarse cells and their states.
        """
        states = self.blocks.halved() if depth < DEPTH else self.blocks.states()
        for level in range(1, DEPTH - depth):
            finer = self.lattice.coarser(level)
            pads = [(k % 2, (k + n) % 2) for k, n in zip(finer.key_min, finer.shape, strict=True)]
            padded = np.pad(states, pads) if any(map(any, pads)) else states
            nx, ny, nz = (n // 2 for n in padded.shape)
            # UNKNOWN < FREE < OCCUPIED: the largest state is the careful one
            states = padded.reshape(nx, 2, ny, 2, nz, 2).max(axis=(1, 3, 5))
        return self.lattice.coarser(DEPTH - depth), states

    def states_at(self, points: ArrayLike, depth: int = DEPTH) -> Bytes:
        """Return states (n,) of the cells that contain points (n, 3), m; UNKNOWN outside of the workspace."""
        lattice, states = (self.lattice, None) if depth == DEPTH else self.coarse(depth)
        index = lattice.indices(np.asarray(points, np.float64).reshape(-1, 3))
        inside = lattice.contains(index)
        out = np.full(index.shape[0], UNKNOWN, np.uint8)
        index = index[inside]
        out[inside] = self.blocks.states_at(index) if states is None else states[tuple(index.T)]
        return out

    def _mark(self, scan: DepthScan | CloudScan) -> tuple[int, int, int]:
        config = self.config
        self._ended[...] = 0
        size = scan.depth.size if isinstance(scan, DepthScan) else scan.points.shape[0]
        if self._ends.shape[0] < size:
            self._ends = np.empty((size, 3), np.int32)
        key_min, axes = self.blocks.key_min, self.blocks.axes
        kept = (axes, self._hits.reshape(-1), self._ended.reshape(-1), self._table, self._ends)
        if isinstance(scan, DepthScan):
            origin = scan.T_base_camera[:3, 3].astype(np.float32)
            label = np.zeros(scan.depth.shape, np.uint8) if scan.label is None else scan.label
            ends, valid, cleared = kernels.image_ends(
                scan.depth, scan.scale, np.float32(scan.near), np.float32(scan.far),
                config.no_return_block if config.clear_without_return else 0, self._stride(scan.intrinsics),
                np.float32(config.no_return_range),
                *scan.rays, np.ascontiguousarray(scan.T_base_camera[:3], dtype=np.float32), label,
                config.resolution, key_min, origin, config.max_range, *kept,
            )  # fmt: skip
        else:
            origin, cleared = scan.origin.astype(np.float32), 0
            label = np.zeros(size, np.uint8) if scan.label is None else scan.label
            ends, valid = kernels.cloud_ends(
                scan.points, label, config.resolution, key_min, origin, config.max_range, *kept
            )
        through = self._through.reshape(-1)
        kernels.walk_rays(self._ends, ends, config.resolution, key_min, origin, config.max_range, axes, through)
        return ends, valid, cleared

    def _apply(self, now: int) -> CellSet:
        config, blocks, changed = self.config, self.blocks, self.blocks.cell_set()
        deltas = np.array([config.miss_log_odds, config.hit_log_odds], np.float32)
        limits = np.array([config.clamp_min, config.clamp_max], np.float32)
        done = 0
        while done < len(self._hits):
            done = cell_kernels.apply_marks(
                self._through, self._hits, done, blocks.rows, blocks.palette, self._seen, now, deltas, limits,
                changed.words,
            )  # fmt: skip
            if done < len(self._hits):
                blocks.grow()
                self._more_seen()
        return changed

    def _tally(self) -> tuple[Ints, int]:
        """Return cells by state (3,), and when the occupied cell was observed that has waited longest, ms."""
        counts = np.zeros(3, np.int64)
        return counts, cell_kernels.tally(self.blocks.rows, self.blocks.palette, self._seen, counts)

    def _more_seen(self) -> None:
        if self._seen.top[0] == 0:
            cell_kernels.drop_seen(self.blocks.rows, self.blocks.palette, self._seen)
            if self._seen.top[0] <= self._seen.pool.shape[0] // 8:  # else this would soon be done again
                self._seen = more_rows(self._seen)

    def _never_seen(self) -> None:
        # ms of the newest observation of occupied cells, in rows of 64
        self._seen = empty_rows(self.lattice.cells // 64, 64, np.int32)

    def _stride(self, intrinsics: Intrinsics) -> int:
        """Pixels between rays that clear without a return: no cell within their range is left out between two."""
        pixels = self.config.resolution * min(intrinsics.fx, intrinsics.fy) / self.config.no_return_range
        return max(1, min(int(pixels), self.config.no_return_block))

    def _milliseconds(self, t_ns: int) -> int:
        """Return the time since the first scan; a clock that was set back begins again."""
        if self._epoch_ns is None or t_ns < self._epoch_ns:
            self._epoch_ns = t_ns
            self._never_seen()
        return (t_ns - self._epoch_ns) // 1_000_000
