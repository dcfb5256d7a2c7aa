# SPDX-License-Identifier: Apache-2.0
"""Pixels over the support divided among things."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.flying_pixels import label_lonely
from openarm_common.config import Config
from openarm_common.types import Array, Bytes, Mask
from openarm_perception.geometry.depth import Points
from openarm_perception.geometry.levels import Levels, find_levels
from openarm_perception.geometry.patch import denoise, keep_edges
from openarm_perception.segmentation.colors import join_alike, join_smooth
from openarm_perception.segmentation.grouping import partition
from openarm_perception.segmentation.kernels import (
    SLANT,
    Labels,
    borders,
    breaks,
    edge_strength,
    grow_patches,
    masked_normals,
    patch_moments,
)
from openarm_perception.segmentation.support import Support

#: So much of a thing stands over what is seen of the support; walls and floors beyond it do not.
_OVER = 0.5
#: Points of a thing that are asked for that.
_ASKED = 200
#: Of its border with a larger thing, so much without a break in depth makes a small piece part of it.
_GROWN_ON = 0.3
#: Of the outline of a strip, so much along a larger thing makes it part of that, whether depth breaks or not.
_ALONG = 0.25
#: What is nowhere wider than a pixel is the edge of something.
_NARROW = 1.0
#: Raised pixels this near to a thing, and to no other, are its own.
_FILLED = 2
#: Unless they lie behind it by more than slant and as many standard deviations of the depth.
_BEHIND = 4.0
#: What stands on another thing rises over it by this multiple of the least height of a thing.
_CARRIED = 2.0


class SegmentationConfig(Config):
    """What counts as a thing."""

    least_height: float = Field(default=0.004, gt=0.0, le=0.1, description="what is lower over the table is table, m")
    faint: float = Field(
        default=1.0, gt=0.0, le=1.0, description="share of that height which what goes on from a thing has at least"
    )
    sigmas: float = Field(
        default=3.5, gt=0.0, le=10.0, description="and what is lower by as many standard deviations of the depth"
    )
    normal_deg: float = Field(
        default=4.0, gt=0.0, le=20.0, description="patches are as large as it takes to know their normals so well, deg"
    )
    least_patch: int = Field(default=6, ge=4, le=64, description="smallest patch across, pixels")
    most_patch: int = Field(default=16, ge=4, le=64, description="largest patch across, pixels")
    least_size: float = Field(
        default=0.012, gt=0.0, le=0.2, description="pieces that are smaller (root of the area) are no things, m"
    )
    join_colors: bool = Field(default=True, description="parts that touch and have the same colour are one thing")
    least_pixels: int = Field(default=60, ge=12, description="nor are pieces of fewer pixels")
    join_parts: bool = Field(
        default=False, description="pieces that touch are one thing, unless both are boxes or cylinders"
    )


@dataclass(frozen=True, eq=False)
class Divided:
    """Pixels of an image divided among things.

    Attributes:
        label: (h, w) uint16, 0: none; 1, 2, …: things, the largest (area) first.
        patch: (h, w) int32, the patches of surface that they are made of.
        even: (h, w, 3) points without the noise of single pixels, optical frame, m.
        surface: (h, w, 3) such points that lie on a surface, also at its edges; NaN where a pixel floats between two.
        heights: (h, w) float32 of those over the support, m.
        pieces: Number of pieces of each thing, which its colours alone have joined.
        levels: Surfaces over the support that things stand on.
    """

    label: NDArray[np.uint16]
    patch: Labels
    even: Points
    surface: Points
    heights: NDArray[np.float32]
    pieces: tuple[int, ...]
    levels: Levels


def divide(
    points: Points,
    intrinsics: Intrinsics,
    support: Support,
    config: SegmentationConfig,
    apart: Mask,
    rgb: Bytes | None = None,
    levels: Levels | None = None,
) -> Divided:
    """Divide what rises above the support among things.

    Args:
        points: (h, w, 3) organised, optical frame, m.
        intrinsics: Intrinsics of the camera.
        support: Surface that things stand on.
        config: Thresholds of what counts as a thing.
        apart: (h, w) pixels of no thing, such as those of the robot.
        rgb: (h, w, 3) uint8; None: parts of one colour are not joined.
        levels: Surfaces over the support that things stand on; None: they are searched.
    """
    pixel = 2.0 / (intrinsics.fx + intrinsics.fy)
    noise = np.float32(support.noise)
    z = points[..., 2]
    smooth, left = denoise(z, pixel)
    even = _points(smooth, intrinsics)
    heights = support.heights(even)
    if levels is None:
        flat = np.concatenate([even @ support.axes.astype(np.float32), heights[..., None]], axis=-1)
        levels = find_levels(flat, apart, _CARRIED * config.least_height)
    else:
        levels = levels.over(heights)
    # without the noise of single pixels, what is as low as that may be a thing
    quiet = replace(support, noise=_noise_left(heights, smooth, support.noise))
    raised = _connected(
        _above(even, heights, quiet, config.faint * config.least_height, config.sigmas) & ~apart,
        _above(even, heights, quiet, config.least_height, config.sigmas),
    )
    raised &= np.isfinite(z)
    flying = _flying(z, pixel, support.noise)
    wanted = raised & ~flying
    size = _patch_size(z[wanted], pixel, support.noise, config)
    broken = breaks(points, wanted, pixel, noise) | levels.ends()
    strength = edge_strength(masked_normals(points, wanted, max(2, size // 2), noise), wanted, max(2, size // 2))
    patch = grow_patches(strength, broken, wanted, size)
    moments = patch_moments(points, patch, int(patch.max()) + 1)
    # metres across of a pixel at a patch, squared
    area = moments[:, 0] * (pixel * moments[:, 3] / np.maximum(moments[:, 0], 1.0)) ** 2
    border = borders(patch, broken, points)
    border = border[~(levels.carry(patch, border[:, :2]) | levels.carry(patch, border[:, 1::-1]))]
    root, _ = partition(moments, border, support.noise)
    root = _join_small(root, patch, area, moments[:, 0], border, size, config)
    if rgb is not None and config.join_colors:
        root = join_alike(root, patch, border, rgb)
    piece = number = _number(root, patch, area, moments, support, intrinsics, config)
    if rgb is not None and config.join_colors:
        root = join_smooth(root, patch, border, rgb)
        number = _number(root, patch, area, moments, support, intrinsics, config)
    pieces = tuple(len(np.unique(piece[(number == i) & (piece > 0)])) for i in range(1, int(number.max()) + 1))
    label = _filled(number[patch], np.where(raised, z, np.nan), pixel, noise)
    surface = _points(np.where(flying, np.nan, keep_edges(z, smooth, left, pixel)), intrinsics)
    return Divided(label, patch, even, surface, heights, pieces, levels)


def _points(z: Array, intrinsics: Intrinsics) -> Points:
    """Return the points (h, w, 3) of depth (h, w), optical frame, m."""
    x, y = intrinsics.rays
    return np.stack([x * z, y[:, None] * z, z], axis=-1).astype(np.float32)


def _filled(label: NDArray[np.uint16], z: NDArray[np.float32], pixel: float, noise: np.float32) -> NDArray[np.uint16]:
    """Return labels (h, w) that also have the pixels next to their own: holes, and those that float.

    What lies behind a thing, such as noise on the table at its far edge, is not its own.

    Args:
        label: (h, w), 0: none.
        z: (h, w) depth of what rises above the support, m; NaN elsewhere.
        pixel: Metres across of a pixel at 1 m.
        noise: Noise of the depth at 1 m, m.
    """
    kernel = np.ones((3, 3), np.uint8)
    behind = np.float32(SLANT * pixel) * z + np.float32(_BEHIND) * noise * z * z
    for _ in range(_FILLED):
        around = cv2.dilate(label, kernel)
        farthest = cv2.dilate(np.where(label > 0, z, np.float32(0.0)), kernel)
        label = np.where((label == 0) & (z <= farthest + behind), around, label)
    return label


def _connected(faint: Mask, clear: Mask) -> Mask:
    """Return those pixels (h, w) that are faint and connected with a clear one."""
    count, found = cv2.connectedComponents(faint.astype(np.uint8), connectivity=8)
    label = np.asarray(found, np.int64)
    with_clear = np.zeros(count, np.bool_)
    with_clear[label[clear & faint]] = True
    with_clear[0] = False
    return with_clear[label]


def _above(points: Points, heights: NDArray[np.float32], support: Support, least: float, sigmas: float) -> Mask:
    """Return which pixels (h, w) rise above the support by more than the noise."""
    with np.errstate(invalid="ignore", divide="ignore"):
        # noise acts along the ray; over a slanted plane it is less
        facing = np.abs(points @ support.normal.astype(np.float32)) / np.linalg.norm(points, axis=-1)
        limit = np.float32(sigmas * support.noise) * points[..., 2] ** 2 * facing
        return heights > np.maximum(np.float32(least), limit)


def _noise_left(heights: NDArray[np.float32], z: Array, noise: float) -> float:
    """Return the noise at 1 m, m, of the heights (h, w) of what is support; a warped image stays a noisy one."""
    with np.errstate(invalid="ignore"):
        off = heights[::4, ::4] / z[::4, ::4] ** 2
        off = np.abs(off[np.abs(off) < 3.0 * noise])
    return 1.4826 * float(np.median(off)) if len(off) else noise


def _flying(z: NDArray[np.float32], pixel: float, noise: float) -> Mask:
    """Return which pixels (h, w) float between surfaces."""
    label = np.zeros(z.shape, np.uint8)
    f = np.float32
    label_lonely(np.nan_to_num(z), f(1.0), f(1e-3), f(1e3), f(SLANT * pixel), f(4.0 * noise), 4, label)
    return label > 0


def _patch_size(z: NDArray[np.float32], pixel: float, noise: float, config: SegmentationConfig) -> int:
    """Return how many pixels across a patch must be so that its normal is known well enough."""
    if not len(z):
        return config.least_patch
    depth = float(np.median(z))
    # a plane through n² points a pixel apart: std of its direction = sqrt(12) · sigma / (n² · pixel)
    n = math.sqrt(math.sqrt(12.0) * noise * depth / (pixel * math.radians(config.normal_deg)))
    return int(np.clip(math.ceil(n), config.least_patch, config.most_patch))


def _join_small(
    root: Labels, patch: Labels, area: Array, pixels: Array, border: Labels, size: int, config: SegmentationConfig
) -> NDArray[np.int32]:
    """Join pieces that are too small to be things to those that they have grown on; return the groups (n,).

    So are pieces that are nowhere as wide as a patch: of these no normal is known, as of the smeared edges of a box.
    """
    root = root.copy()
    for _ in range(2):
        extent = np.bincount(root, weights=area, minlength=len(root))
        count = np.bincount(root, weights=pixels, minlength=len(root))
        small = (extent < config.least_size**2) | (count < config.least_pixels)
        half_width = _half_width(root[patch], len(root))
        thin = half_width < 0.5 * size
        small |= thin
        a, b = root[border[:, 0]], root[border[:, 1]]
        a, b = np.concatenate([a, b]), np.concatenate([b, a])
        between = small[a] & (a != b) & (extent[b] > extent[a])
        if not between.any():
            break
        pairs, index = np.unique(np.stack([a[between], b[between]]), axis=1, return_inverse=True)
        broken = np.tile(border[:, 2] > 0, 2)[between]
        whole = np.bincount(index.ravel(), weights=1.0 - broken)
        length = np.bincount(index.ravel())
        to = np.arange(len(root))
        for i in np.argsort(whole, kind="stable"):  # the longest last
            # a strip along a thing, such as a side that is seen edge on: its outline is its pixels over half its width
            along = thin[pairs[0, i]] and length[i] * half_width[pairs[0, i]] >= _ALONG * count[pairs[0, i]]
            if along or whole[i] >= _GROWN_ON * length[i]:
                to[pairs[0, i]] = pairs[1, i]
        root = to[root].astype(np.int32)
    return root


def _half_width(label: NDArray[np.int32], count: int) -> Array:
    """Return the largest distance (count,) of a pixel of each label to the outside of it, pixels."""
    edge = np.zeros(label.shape, np.bool_)
    edge[:, 1:] |= label[:, 1:] != label[:, :-1]
    edge[1:] |= label[1:] != label[:-1]
    distance = cv2.distanceTransform((~edge).astype(np.uint8), cv2.DIST_L2, 3)
    widest = np.zeros(count)
    np.maximum.at(widest, label[label > 0], distance[label > 0])
    return widest


def _number(
    root: Labels,
    patch: Labels,
    area: Array,
    moments: Array,
    support: Support,
    intrinsics: Intrinsics,
    config: SegmentationConfig,
) -> NDArray[np.uint16]:
    """Return the numbers (n,) of the things that patches belong to, the largest first; 0 of what is none."""
    size = np.bincount(root, weights=area, minlength=len(root))
    count = np.bincount(root, weights=moments[:, 0], minlength=len(root))
    half_width = _half_width(root[patch], len(root))
    number = np.zeros(len(root), np.uint16)
    centre = moments[:, 1:4] / np.maximum(moments[:, :1], 1.0)
    n = 0
    for i in np.argsort(-size, kind="stable"):
        if size[i] < config.least_size**2 or count[i] < config.least_pixels or half_width[i] < _NARROW:
            continue
        members = np.nonzero((root == i) & (moments[:, 0] > 0.0))[0]
        if support.share_over(centre[members[:: max(1, len(members) // _ASKED)]], intrinsics) < _OVER:
            continue
        n += 1
        number[i] = n
    return number[root]
