# SPDX-License-Identifier: Apache-2.0
"""A frame of a camera with all that is known of it, and what a detector sees in it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_perception.detection.detector import Detection2D, Image, Mask
from openarm_perception.geometry.depth import DepthImage, DepthLimits, unit_scale


@dataclass(frozen=True)
class View:
    """Aligned images and where they were taken.

    Attributes:
        rgb: (h, w, 3) uint8.
        depth: (h, w) uint16 millimetres or float32 metres, planar.
        intrinsics: Of both.
        T_base_camera: (4, 4) optical frame in the base frame.
        robot: (h, w) pixels that show the robot or what it holds; None when nobody looked for them.
    """

    rgb: Image
    depth: DepthImage
    intrinsics: Intrinsics
    T_base_camera: NDArray[np.float64]
    robot: Mask | None = None

    def heights(self, limits: DepthLimits, window: tuple[slice, slice] | None = None) -> NDArray[np.float32]:
        """Heights (h, w) of the pixels in the base frame, m; NaN without a depth that counts.

        Args:
            limits: Depths that count.
            window: Rows and columns; all without it.
        """
        rows, columns = window or (slice(0, self.intrinsics.height), slice(0, self.intrinsics.width))
        z = self.depth[rows, columns].astype(np.float32) * np.float32(unit_scale(self.depth))
        z[~((z >= limits.near) & (z <= limits.far))] = np.nan
        lens, up = self.intrinsics, self.T_base_camera[2]
        x = (np.arange(rows.start, rows.stop) - lens.cy) / lens.fy * up[1] + up[2]
        y = (np.arange(columns.start, columns.stop) - lens.cx) / lens.fx * up[0]
        return z * (x[:, None] + y).astype(np.float32) + np.float32(up[3])


@dataclass(frozen=True)
class Doubt:
    """Something that detectors do not agree on: it stands there, but must be looked at again before it is grasped."""

    found: Detection2D
    why: str


@dataclass(frozen=True)
class Seen:
    """What a detector sees: objects, and what it is not sure of."""

    found: tuple[Detection2D, ...]
    doubts: tuple[Doubt, ...] = ()
