# SPDX-License-Identifier: Apache-2.0
"""Is a thing a prism: an upright box or cylinder? Otherwise the box around what was seen of it.

Its top is seen, and its outline, as in `detection.localize`; what is seen elsewhere must lie on the sides. So the cap
of a ball, which is a disc as far as it is level, makes no cylinder of it, and a bowl is no cylinder either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from openarm_common.errors import OpenArmError
from openarm_common.types import Array, Mask
from openarm_perception.geometry import footprint
from openarm_perception.geometry.depth import Points
from openarm_perception.geometry.footprint import Footprint

#: What lies within this of the top is top, m, or within twice the noise.
_BAND = 0.003
#: An outline farther from its shape (rms) is no prism's, m; the noise of an edge comes to it.
_RMS = 0.0025
#: So much of what is seen lies on a prism, within that distance of it, m, and three times the noise.
_SHARE, _NEAR = 0.9, 0.004


@dataclass(frozen=True, eq=False)
class Shape:
    """What a thing looks like from above, in the plane that it stands on.

    Attributes:
        footprint: `rectangle` or `circle`: it is a prism; `bound`: it is none, this is the box around what was seen.
        height: Of its highest place over the plane, m.
        why: Why it is no prism; empty for one.
    """

    footprint: Footprint
    height: float
    why: str

    @property
    def kind(self) -> str:
        """`box`, `cylinder`, or `unknown`."""
        return {"rectangle": "box", "circle": "cylinder"}.get(self.footprint.kind, "unknown")


def judge(mask: Mask, flat: Points, rays: Points, eye: float, hidden: str, pixel: float, noise: float) -> Shape:
    """Fit a prism to a thing.

    Args:
        mask: (h, w) its pixels in a window of the image, which has one pixel more on each side where the image has.
        flat: (h, w, 3) the points of the window: two coordinates along the plane, and the height over it, m.
        rays: (h, w, 3) directions of the pixels, in the same axes; the camera is at (0, 0).
        eye: Height of the camera over the plane, m.
        hidden: What cuts its outline; a prism is not fitted to what is seen in part.
        pixel: Distance of neighbouring pixels at its depth, m.
        noise: Standard deviation of a depth there, m.
    """
    points = flat[mask].astype(np.float64)
    heights = points[:, 2]
    band = max(_BAND, 2.0 * noise)
    near_top = np.quantile(heights, 0.95, method="lower")
    top = float(np.median(heights[np.abs(heights - near_top) <= band]))
    around = footprint.bound(points[:, :2], pixel)
    if hidden:
        return Shape(around, top, f"its outline is cut by {hidden}")
    face = mask & (np.abs(flat[..., 2] - top) <= band)
    try:
        shape = footprint.fit(_edges(face, rays, top - eye), pixel)
    except OpenArmError:
        return Shape(around, top, "its top is neither rectangular nor round")
    if shape.rms > np.hypot(_RMS, pixel):
        return Shape(around, top, f"the outline of its top is {shape.rms * 1e3:.1f} mm (rms) from the nearest prism's")
    share = _on_prism(points, shape, top, max(_NEAR, band) + 3.0 * noise + pixel)
    if share < _SHARE:
        return Shape(around, top, f"{1.0 - share:.0%} of what is seen lies on no prism with its top")
    return Shape(shape, top, "")


def _edges(face: Mask, rays: Points, below: float) -> Array:
    """Return points (n, 2) on the edges of a face: rays between its pixels and those beyond, so far over the camera."""
    h, w = face.shape
    found: list[Array] = []
    v, u = np.nonzero(face)
    for dv, du in ((0, -1), (0, 1), (-1, 0), (1, 0)):
        j, i = v + dv, u + du
        inside = (j >= 0) & (j < h) & (i >= 0) & (i < w)
        edge = inside.copy()
        edge[inside] = ~face[j[inside], i[inside]]
        ray = 0.5 * (rays[v[edge], u[edge]] + rays[j[edge], i[edge]]).astype(np.float64)
        found.append(ray[:, :2] * below / ray[:, 2:])
    return np.concatenate(found)


def _on_prism(points: Array, shape: Footprint, top: float, near: float) -> float:
    """Return the share of points (n, 3) within a distance of the top or the sides of a prism."""
    c, s = np.cos(shape.yaw), np.sin(shape.yaw)
    local = (points[:, :2] - shape.centre) @ np.array([[c, -s], [s, c]])
    if shape.kind == "circle":
        inside = shape.size[0] / 2.0 - np.linalg.norm(local, axis=1)
    else:
        inside = (np.array(shape.size) / 2.0 - np.abs(local)).min(axis=1)
    on_top = (np.abs(points[:, 2] - top) <= near) & (inside >= -near)
    return float(np.mean(on_top | (np.abs(inside) <= near)))
