# SPDX-License-Identifier: Apache-2.0
"""Tags painted into images of things that have none: where a flat square shows, as its camera would see it."""

from __future__ import annotations

import cv2
import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_perception.detection.tags import TagConfig

#: Edge of a module in the picture of a tag, and how often each pixel of the image is sampled along both axes.
_MODULE, _SAMPLES = 12, 4
#: Depth farther from the square than this shows something in front of it, m.
_ON_IT = 0.006


def picture(number: int, dictionary: str = TagConfig().dictionary) -> tuple[np.ndarray, float]:
    """A tag with a white border of a module, and the share of its edge that is the black square."""
    book = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, dictionary))
    modules = book.markerSize + 2
    black = cv2.aruco.generateImageMarker(book, number, modules * _MODULE)
    return np.pad(black, _MODULE, constant_values=255), modules / (modules + 2)


def paint(
    rgb: np.ndarray,
    depth: np.ndarray,
    lens: Intrinsics,
    T_camera_tag: np.ndarray,
    number: int,
    edge: float,
    **book: str,
) -> None:
    """Paint a tag into an image, in place.

    Args:
        rgb: (h, w, 3) uint8.
        depth: (h, w) m, aligned; where it is that of the square, the square shows.
        lens: Of both.
        T_camera_tag: (4, 4) middle of the tag, x to its right, y to its top, m.
        number: Of the tag.
        edge: Of its black square, m.
        book: `dictionary`, unless the default.
    """
    tag, share = picture(number, **book)
    half = 0.5 * edge / share
    points = se3.apply(T_camera_tag, half * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0.0]]))
    corners = lens.project(points)
    if not np.isfinite(corners).all():
        return
    low = np.clip(np.floor(corners.min(axis=0)).astype(int) - 1, 0, (lens.width, lens.height))
    high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 2, 0, (lens.width, lens.height))
    width, height = (int(edge) for edge in high - low)
    if width <= 0 or height <= 0:
        return
    box = (slice(low[1], high[1]), slice(low[0], high[0]))
    n = len(tag) - 0.5
    ends = np.array([[-0.5, -0.5], [n, -0.5], [n, n], [-0.5, n]], np.float32)
    H = cv2.getPerspectiveTransform(ends, ((corners - low + 0.5) * _SAMPLES - 0.5).astype(np.float32))
    size = (width * _SAMPLES, height * _SAMPLES)
    fine = np.stack([cv2.warpPerspective(layer, H, size) for layer in (tag, np.full_like(tag, 255))], axis=-1)
    seen, cover = np.moveaxis(cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA), -1, 0) / 255.0
    rows, columns = np.mgrid[box]
    rays = np.stack([(columns - lens.cx) / lens.fx, (rows - lens.cy) / lens.fy, np.ones((height, width))], axis=-1)
    normal = T_camera_tag[:3, 2]
    plane = (normal @ T_camera_tag[:3, 3]) / (rays @ normal)
    shows = (np.abs(depth[box] - plane) < _ON_IT)[..., None]
    # as bright as paper is under the light of the scenes
    mixed = 230.0 * seen[..., None] + (1.0 - cover[..., None]) * rgb[box]
    rgb[box] = np.where(shows, np.clip(np.rint(mixed), 0, 255), rgb[box]).astype(np.uint8)
