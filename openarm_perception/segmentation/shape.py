# SPDX-License-Identifier: Apache-2.0
"""Is a thing a prism: an upright box or cylinder? Otherwise the box around what was seen of it.

Its top is seen, and its outline, as in `detection.localize`; what is seen elsewhere must lie on the sides. So the cap
of a ball, which is a disc as far as it is level, makes no cylinder of it, and a bowl is no cylinder either.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import OpenArmError
from openarm_common.types import Array, Mask
from openarm_perception.geometry import footprint
from openarm_perception.geometry.footprint import Footprint
from openarm_perception.geometry.patch import denoise

#: What lies within this of the top is top, m, or within three times the noise that is left.
_BAND = 0.003
#: An outline farther from its shape (rms) is no prism's, m; half a pixel comes to it.
_RMS = 0.0025
#: A neighbour below the top within this is on a side, m.
_SIDE_STEP = 0.015
#: Of what is seen below its top, as much may lie farther than this out of a prism, m; half a pixel comes to it.
_OUTER, _WIDER = 0.1, 0.00135
#: Pixels below the top, of which that is asked.
_ASKED = 15
#: Pixels of a thing, without which its depth is not smoothed.
_FEW = 30
#: So much of what is seen lies on a prism, within that distance of it, m, and a pixel.
_SHARE, _NEAR = 0.9, 0.004


@dataclass(frozen=True, eq=False)
class Shape:
    """What a thing looks like from above, in the plane that it stands on.

    Attributes:
        footprint: `rectangle` or `circle`: it is a prism; `bound`: it is none, this is the box around what was seen.
        height: Height of its highest place over the plane, m.
        why: Why it is no prism; empty for one.
    """

    footprint: Footprint
    height: float
    why: str

    @property
    def kind(self) -> str:
        """`box`, `cylinder`, or `unknown`."""
        return {"rectangle": "box", "circle": "cylinder"}.get(self.footprint.kind, "unknown")


def judge(mask: Mask, other: Mask, z: NDArray[np.float32], rays: Array, eye: float, hidden: str, pixel: float) -> Shape:
    """Fit a prism to a thing.

    Args:
        mask: (h, w) its pixels in a window of the image, with some pixels more on each side where the image has them.
        other: (h, w) pixels of other things and of the robot.
        z: (h, w) depth of the window, m.
        rays: (h, w, 3) directions of unit depth of the pixels: two along the plane, and up; the camera is at (0, 0).
        eye: Height of the camera over the plane, m.
        hidden: Neighbours that cut its outline; a prism is not fitted to what is seen in part.
        pixel: Metres across of a pixel at 1 m.
    """
    smooth, left = denoise(z.astype(np.float64), pixel)
    pixel *= float(np.median(z[mask]))
    flat: Array = rays * smooth[..., None] + (0.0, 0.0, eye)
    solid = mask & np.isfinite(smooth)
    if np.count_nonzero(solid) < _FEW:
        flat, solid = rays * z[..., None].astype(np.float64) + (0.0, 0.0, eye), mask
    points = flat[solid]
    band = max(_BAND, 3.0 * left)
    near_top = np.quantile(points[:, 2], 0.95, method="lower")
    top = float(np.median(points[np.abs(points[:, 2] - near_top) <= band, 2]))
    # the pixels of its border lie anywhere between it and what is behind
    inner = cv2.erode(solid.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    whole = np.count_nonzero(inner) > 0.5 * np.count_nonzero(solid)
    around = footprint.bound(flat[inner][:, :2] if whole else points[:, :2], pixel, (2.0 if whole else 1.0) * pixel)
    if hidden:
        return Shape(around, top, f"its outline is cut by {hidden}")
    try:
        shape = footprint.fit(_edges(flat, solid, other, rays, top, eye, band), pixel, whole=True)
    except OpenArmError:
        return Shape(around, top, "its top is neither rectangular nor round")
    if shape.rms > np.hypot(_RMS, 0.5 * pixel):
        return Shape(around, top, f"the outline of its top is {shape.rms * 1e3:.1f} mm (rms) from the nearest prism's")
    seen = flat[inner] if whole else points
    inside = _inside(seen, shape)
    near, below = max(_NEAR, band) + pixel, seen[:, 2] < top - 2.0 * band
    share = float(np.mean(((np.abs(seen[:, 2] - top) <= near) & (inside >= -near)) | (np.abs(inside) <= near)))
    if share < _SHARE:
        return Shape(around, top, f"{1.0 - share:.0%} of what is seen lies on no prism with its top")
    # a rounded or tapered body has a level top, too, but is wider below it
    wider = float(np.quantile(-inside[below], 1.0 - _OUTER)) if np.count_nonzero(below) >= _ASKED else 0.0
    if wider > np.hypot(_WIDER, 0.5 * pixel):
        return Shape(around, top, f"its sides are {wider * 1e3:.1f} mm out of the prism below its top")
    return Shape(shape, top, "")


def _edges(flat: Array, solid: Mask, other: Mask, rays: Array, top: float, eye: float, band: float) -> Array:
    """Return points (n, 2) on the edges of the top, m: rays between its pixels and those beyond, at its height."""
    grown = cv2.dilate(solid.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    level = grown & ~other & (np.abs(flat[..., 2] - top) <= band)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(level.astype(np.uint8), connectivity=4)
    if count < 2:
        return np.empty((0, 2))
    face = labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
    h, w = face.shape
    found: list[Array] = []
    v, u = np.nonzero(face)
    for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        j, i = v + dv, u + du
        edge = (j >= 0) & (j < h) & (i >= 0) & (i < w)
        edge[edge] = ~face[j[edge], i[edge]]
        near, far = (v[edge], u[edge]), (j[edge], i[edge])
        ray = 0.5 * (rays[near] + rays[far])
        # down a side the face goes on as far as heights count as top
        apart = np.linalg.norm(flat[far] - flat[near], axis=1)
        side = solid[far] & (apart <= _SIDE_STEP) & (flat[far][:, 2] < top)
        height = np.where(side, top - band, top)
        found.append(ray[:, :2] * ((height - eye) / ray[:, 2])[:, None])
    return np.concatenate(found)


def _inside(points: Array, shape: Footprint) -> Array:
    """Return how far points (n, 3) are inside of the sides of a prism, m; negative outside."""
    c, s = np.cos(shape.yaw), np.sin(shape.yaw)
    local = (points[:, :2] - shape.centre) @ np.array([[c, -s], [s, c]])
    if shape.kind == "circle":
        return shape.size[0] / 2.0 - np.linalg.norm(local, axis=1)
    return np.asarray((np.array(shape.size) / 2.0 - np.abs(local)).min(axis=1))
