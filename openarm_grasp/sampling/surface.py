# SPDX-License-Identifier: Apache-2.0
"""The surface that grasps are found on: what one or several cameras see of an object and around it, in small voxels.

Depth says what is in front, not what is behind. So each voxel is one of: seen, filled (below a seen point, down to the
table), free (a ray has passed it, or nothing hides it), or in shadow, of the target or of something else. Normals are
those of the smoothed occupancy. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import ceil

import numpy as np
from scipy.ndimage import gaussian_filter1d

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Bytes, Floats
from openarm_grasp.sampling import voxel_kernels as kernels
from openarm_grasp.sampling.voxel_kernels import FILLED, FREE, HIDDEN, OTHER, SEEN, SHADOW

#: Edge of a voxel, m.
VOXEL = 0.0025
#: What stands farther from the target is no matter of a hand that grasps it, m.
AROUND = 0.13
#: Normals are those of the occupancy smoothed by this, voxels: along each axis; less along z, so that what is flat has
#: sides. The direction of a plane does not depend on it.
_BLUR = (1.6, 1.6, 0.7)
#: Fewer points are no object.
_LEAST_POINTS = 20
#: An object that is larger is none that a hand grasps, m.
_LARGEST = 0.8

_NOTHING = np.empty((0, 3))


@dataclass(frozen=True, eq=False)
class View:
    """What one camera sees of an object and around it; points base frame, m, those that are not finite are left out.

    Attributes:
        camera: (3,) position of the camera.
        target: (n, 3) or (h, w, 3) points of the object.
        others: (n, 3) or (h, w, 3) points of everything else that stands there.
        table: (n, 3) or (h, w, 3) points of the table; they say what is free.
        whole: It looks at all that is around the object: what nothing hides from it is free. Of a view that is not
            whole, only what its rays have passed is.
    """

    camera: Array
    target: Array
    others: Array = field(default_factory=lambda: _NOTHING)
    table: Array = field(default_factory=lambda: _NOTHING)
    whole: bool = True


@dataclass(frozen=True, eq=False)
class Surface:
    """An object and what is around it, in voxels.

    Attributes:
        low: (3,) lower corner of the grid; its z is the table.
        step: Edge of a voxel, m.
        cells: (nx, ny, nz) what each voxel holds, see `voxel_kernels`.
        counts: (nx, ny, nz) points of the target in each voxel.
        obstacles: (nx, ny, nz) of the hand: 1 within a voxel of something, 2 the target's shadow, 3 other shadow.
        normals: (nx, ny, nz, 3) outward, of voxels in and next to the target; else 0.
        points: (n, 3) of the target, as they were seen.
        views: Number of cameras that it is from.
    """

    low: Array
    step: float
    cells: Bytes
    counts: kernels.Counts
    obstacles: Bytes
    normals: Floats
    points: Array
    views: int

    @property
    def table_z(self) -> float:
        """Height of the table, m."""
        return float(self.low[2])

    @cached_property
    def solid(self) -> Array:
        """Middles (n, 3) of the voxels of the target, seen or filled."""
        return self.middles(np.argwhere((self.cells == SEEN) | (self.cells == FILLED)))

    @cached_property
    def centroid(self) -> Array:
        """(3,) of the target; its centre of mass, as far as its density is even."""
        return np.asarray(self.solid.mean(axis=0), dtype=np.float64)

    @property
    def top(self) -> float:
        """Height of the highest voxel of the target, m."""
        return float(self.solid[:, 2].max()) + 0.5 * self.step

    @cached_property
    def tight(self) -> Bytes:
        """Obstacles (nx, ny, nz) as `obstacles`, but no larger than what was seen."""
        meaning = np.zeros(HIDDEN + 1, np.uint8)
        meaning[[SEEN, FILLED, OTHER, SHADOW, HIDDEN]] = 1, 1, 1, 2, 3
        return np.asarray(meaning[self.cells])

    def middles(self, index: Array | np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> Array:
        """Middles (n, 3) of voxels (n, 3)."""
        return np.asarray(self.low + (index + 0.5) * self.step, dtype=np.float64)

    def voxel(self, points: Array) -> Array:
        """Coordinates of points (n, 3) in voxels."""
        return np.ascontiguousarray((points - self.low) / self.step)


def fuse(views: Sequence[View], table_z: float, *, step: float = VOXEL, around: float = AROUND) -> Surface:
    """Put together what cameras see of one object.

    Args:
        views: Views, at least one.
        table_z: Height of the table top, m.
        step: Edge of a voxel, m.
        around: Distance from the object beyond which points are left out, m.

    Raises:
        OpenArmError: NOTHING_DETECTED, when fewer than 20 points of the object are above the table; INVALID_ARGUMENT,
            when it is larger than 0.8 m, or the table or a camera is not finite.
    """
    _check(views, table_z)
    least = np.array([-np.inf, -np.inf, table_z])
    mine = [_cloud(view.target, least) for view in views]
    target = np.concatenate([_NOTHING, *mine])
    if len(target) < _LEAST_POINTS:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{len(target)} points of the object above the table at {table_z:.3f} m, expected at least {_LEAST_POINTS}",
        )
    low, high = target.min(axis=0), target.max(axis=0)
    if float((high - low).max()) > _LARGEST:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"the object measures {float((high - low).max()):.2f} m, expected at most {_LARGEST:g} m; are these points"
            " of one object?",
        )
    corner = np.array([low[0] - around, low[1] - around, table_z])
    reach = np.array([high[0] + around, high[1] + around, np.inf])
    others = [(p := _cloud(view.others, corner))[(p < reach).all(axis=1)] for view in views]
    above = max(float(p[:, 2].max(initial=table_z)) for p in (target, *others))
    spans = (np.array([reach[0], reach[1], above]) - corner) / step
    nx, ny, nz = (ceil(float(span)) + margin for span, margin in zip(spans, (1, 1, 4), strict=True))
    shape = (nx, ny, nz)

    def local(points: Array) -> Array:
        return np.ascontiguousarray((points - corner) / step)

    cells, rays = np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
    counts, around_counts = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
    kernels.count(local(target), counts)
    rest = local(np.concatenate([_NOTHING, *others]))
    kernels.count(rest, around_counts)
    kernels.fill(kernels.heights(local(target), nx, ny), kernels.heights(rest, nx, ny), counts, around_counts, cells)
    unknown: list[Bytes] = []
    for view, own, other in zip(views, mine, others, strict=True):
        if view.whole or not any(one.whole for one in views):
            unknown.append(cells.copy())
            kernels.shade(local(other), local(view.camera), HIDDEN, unknown[-1])
            kernels.shade(local(own), local(view.camera), SHADOW, unknown[-1])
    # hidden from all that look there
    cells = np.where(np.min(unknown, axis=0) == FREE, cells, np.max(unknown, axis=0))
    for view, own, other in zip(views, mine, others, strict=True):
        for points in (own, other, _cloud(view.table, np.full(3, -np.inf))):
            kernels.passed(local(points), local(view.camera), rays)
    kernels.carve(rays, around_counts, cells)
    obstacles = np.zeros(shape, np.uint8)
    kernels.grow(cells, obstacles)
    return Surface(corner, step, cells, counts, obstacles, _normals(cells), target, len(views))


def _check(views: Sequence[View], table_z: float) -> None:
    if not views:
        raise OpenArmError(Code.INVALID_ARGUMENT, "no view of the object, expected at least one")
    for view in views:
        if view.camera.shape != (3,) or not np.isfinite(view.camera).all():
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"the camera is at {view.camera.tolist()}, expected three finite coordinates, m"
            )
        for name, points in (("target", view.target), ("others", view.others), ("table", view.table)):
            if points.ndim not in (2, 3) or points.shape[-1] != 3:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT, f"points of {name} have shape {points.shape}, expected (n, 3) or (h, w, 3)"
                )
    if not np.isfinite(table_z):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"the table is at z = {table_z}, expected a finite height, m")


def _cloud(points: Array, least: Array) -> Array:
    """Finite points (n, 3) of a cloud that are above a corner."""
    flat = points.reshape(-1, 3).astype(np.float64)
    return np.asarray(flat[np.isfinite(flat).all(axis=1) & (flat > least).all(axis=1)])


def _normals(cells: Bytes) -> Floats:
    """Outward normals (nx, ny, nz, 3) in and next to the target: those of its occupancy, smoothed.

    The lowest layer goes on below the table, so that where the object meets the table there is no edge.
    """
    solid = (cells == SEEN) | (cells == FILLED)
    normals = np.zeros((*cells.shape, 3), np.float32)
    where = np.argwhere(solid)
    if not len(where):
        return normals
    pad = 5
    low = np.maximum(where.min(axis=0) - pad, 0)
    high = where.max(axis=0) + pad
    part = (slice(low[0], high[0]), slice(low[1], high[1]), slice(0, high[2]))
    soft = solid[part].astype(np.float32)
    for axis, mode in ((0, "constant"), (1, "constant"), (2, "nearest")):
        soft = gaussian_filter1d(soft, _BLUR[axis], axis=axis, mode=mode, truncate=2.0)
    gradient = np.stack([-np.gradient(soft, axis=axis) for axis in range(3)], axis=-1)
    size = np.linalg.norm(gradient, axis=-1, keepdims=True)
    normals[part] = np.where(size > 1e-4, gradient / np.maximum(size, 1e-4), 0.0)
    return normals
