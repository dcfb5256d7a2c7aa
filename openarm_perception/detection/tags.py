# SPDX-License-Identifier: Apache-2.0
"""Tags (AprilTag, ArUco) in a colour image: which they are, where their corners are, and how large they are."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from pydantic import Field, field_validator

from openarm_common.camera.depth_view import unit_scale
from openarm_common.config import Config, RunTimeField
from openarm_common.types import Array, Mask
from openarm_perception.detection.detector import Image, require_rgb
from openarm_perception.geometry.depth import DepthLimits, View

#: The image is enlarged so much: a tag whose modules are two pixels wide is read then.
_ENLARGED = 2


class TagConfig(Config):
    """Which tags are read."""

    dictionary: str = RunTimeField(
        default="DICT_APRILTAG_36H11", description="of the tags, one of OpenCV's, such as DICT_4X4_50"
    )
    size: float = RunTimeField(
        default=0.0,
        ge=0.0,
        le=0.3,
        description="edge of the black square, m; tags of another size are not trusted; 0: any",
    )
    tolerance: float = Field(default=0.2, gt=0.0, le=1.0, description="of that size, as a share of it")

    @field_validator("dictionary")
    @classmethod
    def _known(cls, value: str) -> str:
        known = [name for name in dir(cv2.aruco) if name.startswith("DICT_")]
        if value not in known:
            raise ValueError(f"unknown dictionary {value!r}; dictionaries: {', '.join(known)}")
        return value


@dataclass(frozen=True, eq=False)
class Tag:
    """A tag in an image: its name, and its corners (4, 2), pixels, clockwise from its top left one."""

    name: str
    corners: Array

    def mask(self, shape: tuple[int, int]) -> Mask:
        """Its pixels in an image (h, w)."""
        return cv2.fillConvexPoly(np.zeros(shape, np.uint8), np.round(self.corners).astype(np.int32), 1) > 0

    def edge(self, view: View, limits: DepthLimits) -> float:
        """Its edge by the depth of the frame, m; NaN where that is not known."""
        z = view.depth[self.mask(view.depth.shape)] * unit_scale(view.depth)
        z = z[(z >= limits.near) & (z <= limits.far)]
        lens = view.intrinsics
        K = np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]])
        square = 0.5 * np.array([[-1.0, 1.0, 0.0], [1.0, 1.0, 0.0], [1.0, -1.0, 0.0], [-1.0, -1.0, 0.0]])
        # the distance of a tag with an edge of 1 m that looks like this
        solved, _, t = cv2.solvePnP(square, self.corners, K, np.zeros(5), flags=cv2.SOLVEPNP_IPPE_SQUARE)
        return float(np.median(z) / t[2, 0]) if solved and len(z) else float("nan")


class TagDetector:
    """Finds tags in a colour image.

    Args:
        config: Family and size of the tags.
    """

    def __init__(self, config: TagConfig) -> None:
        self.config = config
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, config.dictionary))
        self._detector = cv2.aruco.ArucoDetector(dictionary)

    def detect(self, rgb: Image) -> tuple[Tag, ...]:
        """Return the tags of an image (h, w, 3) uint8.

        Raises:
            OpenArmError: BAD_IMAGE, for another shape or type.
        """
        require_rgb(rgb)
        grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
        large = cv2.resize(grey, None, fx=_ENLARGED, fy=_ENLARGED, interpolation=cv2.INTER_CUBIC)
        quads, ids, _ = self._detector.detectMarkers(large)
        found: list[Tag] = []
        for quad, number in zip(quads, np.ravel(ids) if quads else (), strict=True):
            corners = (np.asarray(quad, np.float64).reshape(4, 2) + 0.5) / _ENLARGED - 0.5
            found.append(Tag(f"tag_{int(number)}", corners))
        return tuple(found)

    def doubt(self, tag: Tag, view: View, limits: DepthLimits) -> str:
        """Why a tag is not trusted, by its size; "" when it is, or any size will do."""
        size, edge = self.config.size, tag.edge(view, limits)
        if size == 0.0 or abs(edge - size) <= self.config.tolerance * size:
            return ""
        return f"its edge is {edge * 1e3:.0f} mm, expected {size * 1e3:.0f} mm (tag.size)"
