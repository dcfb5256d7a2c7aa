# SPDX-License-Identifier: Apache-2.0
"""The points of what was detected, and of what is around it: what a grasp of things of any shape is found on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.types import Floats
from openarm_perception.detection.localize import LocatedObject
from openarm_perception.geometry.depth import Deprojector, DepthLimits, View
from openarm_perception.geometry.patch import smoothed

#: What lies farther from every detection is far, m.
_AROUND = 0.15
#: Of what is no detection, every so manieth row and column is enough: near one, and elsewhere.
_SPARSE, _FAR = 2, 4


def smooth_depth(view: View, limits: DepthLimits) -> Floats:
    """Return the depth (h, w) of an image without the noise of single pixels, m; NaN where none counts."""
    return smoothed(view.metres(limits), view.intrinsics)


def labelled_cloud(
    view: View,
    smooth: Floats,
    boxes: Sequence[LocatedObject],
    limits: DepthLimits,
    flying: FlyingConfig = FlyingConfig(),  # noqa: B008 - frozen
) -> LabelledCloud:
    """Return the points of detections and, fewer, of everything else, in the optical frame.

    Pixels of the robot, of what it holds, and those that float between surfaces are left out. One of several detections
    is of the smallest: that is in front of the others, or stands on them.

    Args:
        view: The image.
        smooth: (h, w) its depth as of `smooth_depth`.
        boxes: Objects that were detected in it; the i-th has label i, counted from 1.
        limits: Depths that count.
        flying: Thresholds of pixels that float.
    """
    label, near = np.zeros(view.depth.shape, np.uint32), np.zeros(view.depth.shape, np.bool_)
    scan = DepthView(view.depth, view.intrinsics, view.T_base_camera, limits.near, limits.far)
    for i, place in sorted(enumerate(boxes, start=1), key=lambda one: -np.count_nonzero(one[1].source.mask)):
        (u, v), (width, height) = place.source.origin, place.source.size
        label[v : v + height, u : u + width][place.source.mask] = i
        near[_window(place, scan, label.shape)] = True
    sparse = np.zeros_like(near)
    sparse[::_SPARSE, ::_SPARSE] = True
    kept = (label > 0) | (near & sparse)
    kept[::_FAR, ::_FAR] = True
    if view.robot is not None:
        kept &= ~view.robot
    floats = np.zeros(label.shape, np.uint8)
    if flying.enabled:
        label_flying(scan, flying, floats)
    points = Deprojector(limits).organised(smooth, view.intrinsics)
    kept &= (floats == 0) & np.isfinite(points[..., 2])
    return LabelledCloud(points[kept], label[kept], np.zeros(3))


def _window(place: LocatedObject, scan: DepthView, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Rows and columns of an image within 0.15 m of a detection."""
    (u, v), (width, height) = place.source.origin, place.source.size
    depths: NDArray[np.float32] = scan.depth[v : v + height, u : u + width][place.source.mask] * scan.scale
    depths = depths[(depths >= scan.near) & (depths <= scan.far)]
    if not depths.size:
        return slice(0, 0), slice(0, 0)
    reach = round(_AROUND * max(scan.intrinsics.fx, scan.intrinsics.fy) / float(np.median(depths)))
    return (
        slice(max(v - reach, 0), min(v + height + reach, shape[0])),
        slice(max(u - reach, 0), min(u + width + reach, shape[1])),
    )
