# SPDX-License-Identifier: Apache-2.0
"""Depth of a rectified pair by semi-global matching (Hirschmüller, PAMI 2008), as OpenCV's StereoSGBM computes it.

A pixel has depth where the match of the left image in the right one and the match back agree, where no other match is
about as good, and where the region of its depth is no speckle. What one camera alone sees, and what lies outside the
limits, has none. Depth is planar, along the optical axis of the rectified left camera.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.kernels import kernel
from openarm_common.types import Bytes, Floats
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.stereo.rectification import Rectification

#: StereoSGBM's disparities are in sixteenths of a pixel.
_STEPS = 16
#: Most disparities that are tried: memory and time grow with them.
_MOST_DISPARITIES = 1024
#: For StereoSGBM, which takes 0 and less as 1.
_UNCHECKED = 1_000_000
_MODES = {"3way": cv2.STEREO_SGBM_MODE_SGBM_3WAY, "5way": cv2.STEREO_SGBM_MODE_SGBM, "8way": cv2.STEREO_SGBM_MODE_HH}
Disparities = NDArray[np.int16]


class StereoConfig(Config):
    """How two images are matched."""

    block: int = Field(default=5, ge=1, le=15, description="edge of the windows that are compared, pixels; odd")
    paths: Literal["3way", "5way", "8way"] = Field(
        default="3way", description="directions that smoothness is summed along; more take longer, and more memory"
    )
    smoothness: float = Field(
        default=1.0, gt=0.0, le=10.0, description="cost of a change of disparity between neighbours; 1: as OpenCV says"
    )
    uniqueness: int = Field(
        default=10, ge=0, le=50, description="the best match costs less than any other by this share, percent"
    )
    left_right: float = Field(
        default=1.0, ge=0.0, le=16.0, description="most that the match back may differ, pixels; 0: no match back"
    )
    texture: float = Field(
        default=0.0,
        ge=0.0,
        le=50.0,
        description="least rms step along the rows of a window, without which no match is sure, of 255; 0: any",
    )
    speckle_size: int = Field(
        default=100, ge=0, le=10_000, description="a region of one depth that is smaller is dropped, pixels; 0: none"
    )
    speckle_range: int = Field(
        default=1, ge=1, le=16, description="neighbours of one region differ by less in disparity, pixels"
    )

    @field_validator("block")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError(f"expected an odd number, got {value}")
        return value


class StereoMatcher:
    """Computes depth of the pairs of one rectification.

    Args:
        config: Settings of the matching.
        rectification: Rectification of the pair.
        limits: Depths that count; the nearest decides how many disparities are tried.

    Raises:
        OpenArmError: CONFIG_INVALID, when the nearest depth needs too many disparities.
    """

    def __init__(self, config: StereoConfig, rectification: Rectification, limits: DepthLimits) -> None:
        self.rectification = rectification
        self._config, self._limits = config, limits
        scale = rectification.intrinsics.fx * rectification.baseline
        least, most = int(scale / limits.far), int(np.ceil(scale / limits.near)) + 1
        self._count = -(-(most - least) // _STEPS) * _STEPS
        if self._count > min(_MOST_DISPARITIES, rectification.intrinsics.width):
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"a nearest depth of {limits.near:g} m is a disparity of {scale / limits.near:.0f} pixels with this"
                f" pair, expected at most {min(_MOST_DISPARITIES, rectification.intrinsics.width)}; raise `near` of the"
                " camera, or take smaller images",
            )
        self._least, self._pad = least, least + self._count
        area = config.block**2
        self._sgbm = cv2.StereoSGBM.create(
            minDisparity=least,
            numDisparities=self._count,
            blockSize=config.block,
            P1=max(1, round(8 * area * config.smoothness)),
            P2=max(2, round(32 * area * config.smoothness)),
            # its own check compares with matches of the right image in the costs of the left one
            disp12MaxDiff=max(1, round(config.left_right)) if config.left_right > 0.0 else _UNCHECKED,
            preFilterCap=31,
            uniquenessRatio=config.uniqueness,
            mode=_MODES[config.paths],
        )

    def depth(self, left: Bytes, right: Bytes) -> Floats:
        """Return the depth (h, w) of the rectified left camera, m; NaN where there is none.

        Args:
            left: (h, w) or (h, w, 3), as the camera took it.
            right: The same of the right camera, at the same moment.

        Raises:
            OpenArmError: BAD_IMAGE, for an image of another size than its camera's.
        """
        first, second = (_grey(image) for image in self.rectification.rectify(left, right))
        disparity = self._match(first, second)
        if self._config.left_right > 0.0:
            back = self._match(second[:, ::-1], first[:, ::-1])[:, ::-1]
            _check_back(disparity, np.ascontiguousarray(back), round(self._config.left_right * _STEPS))
        if self._config.texture > 0.0:
            disparity[_steps(first, self._config.block) < self._config.texture] = -1
        if self._config.speckle_size > 0:
            cv2.filterSpeckles(disparity, -1, self._config.speckle_size, self._config.speckle_range * _STEPS)
        lens = self.rectification.intrinsics
        out = np.empty(disparity.shape, np.float32)
        scale = np.float32(lens.fx * self.rectification.baseline * _STEPS)
        _to_depth(disparity, scale, np.float32(self._limits.near), np.float32(self._limits.far), out)
        return out

    def _match(self, first: Bytes, second: Bytes) -> Disparities:
        """Return the disparities of the first image, in sixteenths; -1 where there is none.

        The matcher skips as many columns as there are disparities; a margin lets it match what the other camera sees of
        them.
        """
        wide = [cv2.copyMakeBorder(image, 0, 0, self._pad, 0, cv2.BORDER_REPLICATE) for image in (first, second)]
        found = np.asarray(self._sgbm.compute(*wide), np.int16)[:, self._pad :]
        return np.ascontiguousarray(_inside(np.ascontiguousarray(found), self._least * _STEPS))


@kernel
def _inside(disparity: Disparities, least: int) -> Disparities:
    """Mark as -1 what has no match, or one outside the other image."""
    for v in range(disparity.shape[0]):
        for u in range(disparity.shape[1]):
            if disparity[v, u] < max(least, 1) or disparity[v, u] > u * _STEPS:
                disparity[v, u] = -1
    return disparity


@kernel
def _check_back(disparity: Disparities, back: Disparities, most: int) -> None:
    """Mark as -1 what the match back contradicts, or does not confirm."""
    for v in range(disparity.shape[0]):
        for u in range(disparity.shape[1]):
            d = disparity[v, u]
            if d < 0:
                continue
            there = u - (d + _STEPS // 2) // _STEPS
            if there < 0 or back[v, there] < 0 or abs(back[v, there] - d) > most:
                disparity[v, u] = -1


@kernel
def _to_depth(disparity: Disparities, scale: np.float32, near: np.float32, far: np.float32, out: Floats) -> None:
    for v in range(disparity.shape[0]):
        for u in range(disparity.shape[1]):
            z = scale / np.float32(disparity[v, u]) if disparity[v, u] > 0 else np.float32(np.nan)
            out[v, u] = z if near <= z <= far else np.float32(np.nan)


def _grey(image: Bytes) -> Bytes:
    return image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)


def _steps(image: Bytes, block: int) -> Floats:
    """Return the rms difference of neighbours along the rows, in the window about each pixel."""
    grey = image.astype(np.float32)
    step = np.diff(grey, axis=1, append=grey[:, -1:])
    return np.sqrt(cv2.blur(step * step, (block, block))).astype(np.float32)
