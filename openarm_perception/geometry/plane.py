# SPDX-License-Identifier: Apache-2.0
"""Positions of objects without depth: pixel rays cut with planes, for a camera in any attitude.

The base frame has z up; planes are given as ``normal · p = offset``. All lengths in metres, pixels as in
`openarm_perception.detection.detector`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.detection.detector import Detection2D

#: A ray this flat over a plane, as a sine, has no intersection that an image could resolve.
_GRAZING = 0.02


def intersect(
    pixels: ArrayLike, intrinsics: Intrinsics, T_base_camera: Array, normal: ArrayLike, offset: float
) -> Array:
    """Return points (..., 3) of a plane in the base frame that pixels (..., 2) show.

    Args:
        pixels: (u, v).
        intrinsics: Intrinsics of the camera, from its CameraInfo.
        T_base_camera: (4, 4) optical frame in the base frame.
        normal: (3,) of the plane, of any length but zero.
        offset: `normal · p` of its points.

    Raises:
        OpenArmError: NOTHING_DETECTED, when a pixel shows the horizon of the plane, or what is above it.
    """
    n = np.asarray(normal, np.float64)
    uv = np.asarray(pixels, np.float64)
    rays = intrinsics.deproject(uv, np.ones(uv.shape[:-1])) @ T_base_camera[:3, :3].T
    slope = rays @ n / (np.linalg.norm(rays, axis=-1) * np.linalg.norm(n))
    height = offset - T_base_camera[:3, 3] @ n
    if not (slope * np.sign(height) > _GRAZING).all():
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            "a pixel's ray runs along the plane or away from it; expected it below the plane's horizon in the image",
        )
    return T_base_camera[:3, 3] + rays * (height / (rays @ n))[..., None]


def outline(
    found: Detection2D, intrinsics: Intrinsics, T_base_camera: Array, bottom: float, top: float, spacing: float
) -> Array:
    """Return the outline of an upright convex prism from its silhouette alone; its bottom and top heights are known.

    Cut with the plane of the bottom, the rays of the silhouette enclose the footprint and the shadow that the prism
    throws away from the camera; cut with that of the top, the footprint and what leans towards the camera. The two
    share the footprint alone, exactly.

    Args:
        found: The detection; its mask is the silhouette.
        intrinsics: Intrinsics of the camera.
        T_base_camera: (4, 4) optical frame in the base frame.
        bottom: Height of the table, m.
        top: Height of the object's top, m; below the camera.
        spacing: Distance of the points that are returned, m.

    Returns:
        (n, 2) points on the outline of the footprint.

    Raises:
        OpenArmError: NOTHING_DETECTED, when the camera is not above the object, or the heights do not fit it.
    """
    if T_base_camera[2, 3] <= top:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"the camera is {T_base_camera[2, 3]:.3f} m high, expected above the object's top at {top:.3f} m",
        )
    v, u = np.nonzero(found.mask)
    centres = np.stack([u + found.origin[0], v + found.origin[1]], axis=-1).astype(np.float64)
    # the edge lies half a pixel outside of the outermost centres
    steps = np.array([(-0.5, 0.0), (0.5, 0.0), (0.0, -0.5), (0.0, 0.5)])
    around = (centres[:, None] + steps).reshape(-1, 2)
    hull = cv2.convexHull(around.astype(np.float32))[:, 0].astype(np.float64)
    low, high = (intersect(hull, intrinsics, T_base_camera, (0.0, 0.0, 1.0), z)[:, :2] for z in (bottom, top))
    middle = low.mean(axis=0)
    # in millimetres around the middle: OpenCV computes in float32
    area, shared = cv2.intersectConvexConvex(
        ((low - middle) * 1e3).astype(np.float32), ((high - middle) * 1e3).astype(np.float32)
    )
    if area <= 0.0 or shared is None:
        raise OpenArmError(
            Code.NOTHING_DETECTED, f"no prism between the heights {bottom:.3f} and {top:.3f} m has this silhouette"
        )
    corners = shared[:, 0].astype(np.float64) * 1e-3 + middle
    points: list[Array] = []
    for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        count = max(1, int(np.linalg.norm(b - a) / spacing))
        points.append(a + (b - a) * (np.arange(count) / count)[:, None])
    return np.concatenate(points)
