# SPDX-License-Identifier: Apache-2.0
"""Things on a table, each with its pixels, its points and what is known of its shape."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array, Bytes, Mask
from openarm_perception.geometry.depth import Points
from openarm_perception.geometry.levels import Levels
from openarm_perception.segmentation.background import nearer, noise_between
from openarm_perception.segmentation.divide import SegmentationConfig, divide
from openarm_perception.segmentation.outline import Outline, survey
from openarm_perception.segmentation.parts import joined
from openarm_perception.segmentation.shape import Shape, judge
from openarm_perception.segmentation.support import Support, find_support

#: Pixels around a thing that are looked at for its edges.
_MARGIN = 4


@dataclass(frozen=True, eq=False)
class Cluster:
    """A thing that was seen.

    Attributes:
        id: Its number in the label image.
        window: Rows and columns of the image around it.
        mask: (h, w) bool, its pixels within the window.
        points: (n, 3) float32 of those of its pixels that lie on a surface, without their noise, in row order, m; base
            frame, or the camera's where its pose is not known.
        height: Height of its highest place over the surface that it stands on, m.
        outline: Neighbours beyond its outline.
        shape: Whether a prism fits it.
        T_frame_box: (4, 4) middle of the box around it, in the frame of the points; z away from the support.
        size: (3,) of that box, m; x is the smaller horizontal edge.
        color: Median (r, g, b), 0 to 255; None without a colour image.
    """

    id: int
    window: tuple[slice, slice]
    mask: Mask
    points: Points
    height: float
    outline: Outline
    shape: Shape
    T_frame_box: Array
    size: Array
    color: tuple[int, int, int] | None

    @property
    def pixels(self) -> int:
        """How many pixels with a depth it has."""
        return int(np.count_nonzero(self.mask))


@dataclass(frozen=True, eq=False)
class Segmentation:
    """What stands on a support.

    Attributes:
        label: (h, w) uint16, 0: no thing; else the `id` of a cluster.
        clusters: Largest (area) first; their ids are 1, 2, …
        support: Surface that they stand on, or what carries them.
        heights: (h, w) float32 over it, m; NaN where nothing was measured.
    """

    label: NDArray[np.uint16]
    clusters: tuple[Cluster, ...]
    support: Support
    heights: NDArray[np.float32]


def segment(
    points: Points,
    intrinsics: Intrinsics,
    config: SegmentationConfig = SegmentationConfig(),  # noqa: B008 - frozen
    *,
    rgb: Bytes | None = None,
    T_base_camera: Array | None = None,
    robot: Mask | None = None,
    background: Points | None = None,
    support: Support | None = None,
    levels: Levels | None = None,
) -> Segmentation:
    """Find what stands on the table, or on other things there, in the organised cloud of one camera.

    Args:
        points: (h, w, 3) float32, optical frame, m; NaN where nothing was measured.
        intrinsics: Intrinsics of the camera.
        config: Thresholds of what counts as a thing.
        rgb: (h, w, 3) uint8 aligned with it: clusters have a colour then.
        T_base_camera: (4, 4) optical frame in the base frame, whose z points up; None: the support may be slanted.
        robot: (h, w) pixels that show the robot or what it holds.
        background: (h, w, 3) as `points`, of the empty table or box; the support is found there, and what is no nearer
            than it is no thing.
        support: Surface that things stand on, where it is known.
        levels: Surfaces over it that things stand on; None: they are searched.

    Raises:
        OpenArmError: BAD_IMAGE, for a background of another place; NOTHING_DETECTED, when there is no plane that things
            may stand on.
    """
    robot = np.zeros(points.shape[:2], np.bool_) if robot is None else robot
    if support is None:
        seen = np.where(robot[..., None], np.float32(np.nan), points) if background is None else background
        support = find_support(seen, None if T_base_camera is None else T_base_camera[2, :3])
    apart = robot
    if background is not None:
        support = replace(support, noise=noise_between(points, background, support.noise))
        apart = robot | ~nearer(points, background, support.noise, config.sigmas, config.least_height)
    divided = divide(points, intrinsics, support, config, apart, rgb, levels)
    T = np.eye(4) if T_base_camera is None else T_base_camera
    image = _Image(points, divided.even, divided.surface, intrinsics, support, divided.levels, T, robot, rgb)
    label, found = divided.label, image.clusters(divided.label)
    if config.join_parts:
        root = joined(found, label, divided.pieces, _carried(divided.levels, label, len(found)))
        _, number = np.unique(root, return_inverse=True)
        if len(found) and number.max() + 1 < len(found):
            label = np.concatenate([[0], number + 1]).astype(np.uint16)[label]
            found = image.clusters(label)
    return Segmentation(label, found, support, divided.heights)


@dataclass(frozen=True, eq=False)
class _Image:
    """What clusters are described by; as the arguments of `segment`, and points without noise as of `Divided`."""

    points: Points
    even: Points
    surface: Points
    intrinsics: Intrinsics
    support: Support
    levels: Levels
    T_frame_camera: Array
    robot: Mask
    rgb: Bytes | None

    def clusters(self, label: NDArray[np.uint16]) -> tuple[Cluster, ...]:
        """Return the things 1, 2, … of a label image."""
        outlines = survey(label, self.even, self.robot, self.support.noise)
        return tuple(self._cluster(label, i, one) for i, one in enumerate(outlines, start=1))

    def _cluster(self, label: NDArray[np.uint16], i: int, outline: Outline) -> Cluster:
        window, T, support = _window(label, i), self.T_frame_camera, self.support
        # from the surface under it
        eye = support.offset - float(self.levels.height[self.levels.of(window, label[window] == i)])
        T_plane_camera = se3.make(np.stack([*support.axes.T, support.normal]), (0.0, 0.0, eye))
        mask, local, z = label[window] == i, self.surface[window], self.points[window][..., 2]
        other = ((label[window] != 0) & ~mask) | self.robot[window]
        lens = self.intrinsics
        shape = judge(
            mask, other, z, _rays(lens, window, T_plane_camera), eye, outline.cut, 2.0 / (lens.fx + lens.fy)
        )  # fmt: skip
        T_plane_box = se3.make(se3.rot_z(shape.footprint.yaw), (*shape.footprint.centre, shape.height / 2.0))
        color = None
        if self.rgb is not None:
            r, g, b = (int(v) for v in np.median(self.rgb[window][mask], axis=0))
            color = (r, g, b)
        placed = local[mask & np.isfinite(local[..., 2])] @ T[:3, :3].T.astype(np.float32) + T[:3, 3].astype(np.float32)
        size = np.array([*shape.footprint.size, shape.height])
        T_frame_box = T @ se3.inverse(T_plane_camera) @ T_plane_box
        return Cluster(i, window, mask, placed, shape.height, outline, shape, T_frame_box, size, color)


def _carried(levels: Levels, label: NDArray[np.uint16], count: int) -> NDArray[np.bool_]:
    """Return which of the things (n, n) carry each other, also by what stands between them."""
    pairs = np.indices((count, count)).reshape(2, -1).T + 1
    found = levels.carry(label, pairs).reshape(count, count)
    for _ in levels.height:
        found |= found @ found
    return found | found.T


def _window(label: NDArray[np.uint16], i: int) -> tuple[slice, slice]:
    """Return rows and columns around a thing, with a few pixels more on each side where the image has them."""
    on = label == i
    rows, columns = np.nonzero(on.any(axis=1))[0], np.nonzero(on.any(axis=0))[0]
    top, left = max(int(rows[0]) - _MARGIN, 0), max(int(columns[0]) - _MARGIN, 0)
    height, width = label.shape
    bottom, right = min(int(rows[-1]) + 1 + _MARGIN, height), min(int(columns[-1]) + 1 + _MARGIN, width)
    return slice(top, bottom), slice(left, right)


def _rays(intrinsics: Intrinsics, window: tuple[slice, slice], T_plane_camera: Array) -> Array:
    """Return the directions (h, w, 3) of unit depth of the pixels of a window, in the axes of the plane."""
    x, y = intrinsics.rays
    x, y = x[window[1]], y[window[0]]
    rays = np.ones((len(y), len(x), 3))
    rays[..., 0], rays[..., 1] = x, y[:, None]
    return rays @ T_plane_camera[:3, :3].T
