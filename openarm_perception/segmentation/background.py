# SPDX-License-Identifier: Apache-2.0
"""What is nearer to the camera than the empty table or box was, seen from the same place."""

from __future__ import annotations

import cv2
import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Mask
from openarm_perception.geometry.depth import Points
from openarm_perception.segmentation.support import LEAST_NOISE

#: Standard deviation of normal noise over the median of its absolute values.
_MAD = 1.4826


def noise_between(points: Points, background: Points, most: float) -> float:
    """Return the noise of depths at 1 m, m: of the pixels that show the background in both images.

    What the two have in common, such as a warped image or a bent table, is no noise here.

    Args:
        points: (h, w, 3), m.
        background: (h, w, 3), m.
        most: Noise of a depth at 1 m; what differs by three times as much is no background.

    Raises:
        OpenArmError: BAD_IMAGE, for a background of another size, or when hardly any pixel shows it.
    """
    if background.shape != points.shape:
        sizes = f"{background.shape[1]}x{background.shape[0]} pixels, and the frame {points.shape[1]}x{points.shape[0]}"
        raise OpenArmError(Code.BAD_IMAGE, f"the background is {sizes}; expected the same camera in the same place")
    with np.errstate(invalid="ignore"):
        off = np.abs(background[..., 2] - points[..., 2]) / points[..., 2] ** 2
        same = off[off < 3.0 * most]
    if len(same) < 0.02 * off.size:
        raise OpenArmError(
            Code.BAD_IMAGE,
            f"{len(same) / off.size:.1%} of the pixels show the background, expected at least 2 %; has it moved?",
        )
    return float(np.clip(_MAD * np.median(same) / np.sqrt(2.0), LEAST_NOISE, most))


def nearer(points: Points, background: Points, noise: float, sigmas: float, least: float) -> Mask:
    """Return which pixels (h, w) are nearer to the camera than the background.

    Args:
        points: (h, w, 3), m.
        background: (h, w, 3), m; what has no depth there is not nearer.
        noise: Noise of a depth at 1 m, m.
        sigmas: Number of standard deviations.
        least: And by so much, m.
    """
    # neighbours count too: at steps of the background a pixel may show either side, or nothing
    behind = np.where(np.isfinite(background[..., 2]), background[..., 2], np.float32(np.inf))
    behind = cv2.erode(behind, np.ones((3, 3), np.uint8))
    z = points[..., 2]
    with np.errstate(invalid="ignore"):
        step = np.maximum(np.float32(least), np.float32(sigmas * noise) * z * z)
        return np.asarray((behind - z > step) & np.isfinite(behind))
