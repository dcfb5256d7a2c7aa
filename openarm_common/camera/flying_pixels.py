# SPDX-License-Identifier: Apache-2.0
"""Flying pixels: depths that a sensor reports between a near and a far surface, where there is nothing.

At the borders of objects a pixel covers two surfaces, and its depth is any value between theirs. Such a pixel has
hardly a neighbour at its own depth. One on a surface has: along a plane of slant a, seen by a camera of focal length f
(pixels), the depth z changes by z · tan(a) / f from pixel to pixel, and by the noise of the sensor, which for a stereo
camera grows with the square of z. Depths are planar, m.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from openarm_common.camera.depth_view import DepthImage, DepthView
from openarm_common.config import Config
from openarm_common.kernels import kernel
from openarm_common.types import Bytes

#: Label of a pixel whose depth says nothing: it neither marks nor clears.
NOTHING_KNOWN = 2


class FlyingConfig(Config):
    """Which pixels of a depth image lie between surfaces rather than on one."""

    enabled: bool = Field(default=True, description="leave out pixels that float between surfaces")
    neighbours: int = Field(default=4, ge=1, le=8, description="a pixel of a surface has as many of eight at its depth")
    slant_deg: float = Field(
        default=75.0, ge=0.0, le=88.0, description="surfaces up to this slant from facing the camera are kept"
    )
    noise: float = Field(
        default=0.006,
        ge=0.0,
        le=0.1,
        description="neighbours may differ by so much more at 1 m, growing with the square; 1.5 times the rms error, m",
    )


def label_flying(view: DepthView, config: FlyingConfig, label: Bytes) -> int:
    """Label the flying pixels of a depth image.

    Args:
        view: The image; its intrinsics say how far apart neighbours are.
        config: Thresholds of what counts as flying.
        label: (h, w), NOTHING_KNOWN is written where it is 0 and the pixel flies.

    Returns:
        How many there are.
    """
    share = math.tan(math.radians(config.slant_deg)) / min(view.intrinsics.fx, view.intrinsics.fy)
    near, far, per_metre, per_square = (np.float32(v) for v in (view.near, view.far, share, config.noise))
    return int(label_lonely(view.depth, view.scale, near, far, per_metre, per_square, config.neighbours, label))


@kernel
def label_lonely(
    depth: DepthImage, scale: np.float32, near: np.float32, far: np.float32,
    share: np.float32, noise: np.float32, neighbours: int, label: Bytes,
) -> int:  # fmt: skip
    """Label pixels that have too few neighbours at their depth.

    Args:
        depth: (h, w) planar depth in counts of `scale` metres.
        scale: Metres of a count.
        near: Nearest valid depth, m; what is not valid keeps its label.
        far: Farthest valid depth, m.
        share: A neighbour is at the same depth z when it differs by less than share · z + noise · z², m/m.
        noise: 1/m.
        neighbours: Number of the eight that must be.
        label: (h, w), NOTHING_KNOWN is written over 0.

    Returns:
        How many were labelled.
    """
    h, w = depth.shape
    # three rows in metres with a border of zeros: no test for the border is left in the loop, which becomes vector code
    rows = np.zeros((3, w + 2), np.float32)
    for u in range(w if h else 0):
        rows[1, u + 1] = np.float32(depth[0, u]) * scale
    count = 0
    for v in range(h):
        above, here, below = rows[v % 3], rows[(v + 1) % 3], rows[(v + 2) % 3]
        if v + 1 < h:
            for u in range(w):
                below[u + 1] = np.float32(depth[v + 1, u]) * scale
        else:
            below[:] = np.float32(0.0)
        line = label[v]
        for u in range(w):
            z = here[u + 1]
            limit = (share + noise * z) * z
            same = np.int32(abs(above[u] - z) < limit)
            same += np.int32(abs(above[u + 1] - z) < limit)
            same += np.int32(abs(above[u + 2] - z) < limit)
            same += np.int32(abs(here[u] - z) < limit)
            same += np.int32(abs(here[u + 2] - z) < limit)
            same += np.int32(abs(below[u] - z) < limit)
            same += np.int32(abs(below[u + 1] - z) < limit)
            same += np.int32(abs(below[u + 2] - z) < limit)
            lonely = (z >= near) & (z <= far) & (same < neighbours) & (line[u] == 0)
            line[u] = np.uint8(NOTHING_KNOWN) if lonely else line[u]
            count += lonely
    return count
