# SPDX-License-Identifier: Apache-2.0
"""Rectification of a stereo pair: both images as if taken by equal cameras side by side, rows on rows.

Frames are optical (z forward, x right, y down). The rectified left camera has the place of the left one, and its
orientation where that is rectified already; otherwise it is turned a little, so its mount is to be calibrated with
rectified images.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import check_size
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Bytes

Map = NDArray[np.int16 | np.uint16]
#: Focal lengths and centres of two rectified cameras differ by no more, pixels.
_SAME_PX = 1e-3
#: Closer together, two cameras see no depth, m; further apart than this they are none of one robot's head.
_BASELINES = (0.005, 2.0)


@dataclass(frozen=True, eq=False)
class Rectified:
    """What makes a rectified image of one camera's.

    Attributes:
        lens: Lens of the camera.
        R: Rotation to the rectified frame, (3, 3).
        P: Projection of the rectified camera, (3, 4), pixels; P[0, 3] of the right one is -fx × baseline.
    """

    lens: Lens
    R: Array
    P: Array

    def maps(self) -> tuple[Map, Map] | None:
        """Return where each rectified pixel is found in the image, as `cv2.remap` takes it; None: where it is."""
        K = self.P[:, :3]
        unturned = np.allclose(self.R, np.eye(3), atol=1e-9)
        if self.lens.straight and unturned and np.allclose(K, self.lens.intrinsics.matrix, atol=1e-6):
            return None
        made = cv2.convertMaps(*self.lens.maps(self.R, K), cv2.CV_16SC2)
        return np.asarray(made[0], np.int16), np.asarray(made[1], np.uint16)


class Rectification:
    """Makes rectified pairs.

    Args:
        left: Lens of the left camera.
        right: Lens of the right camera.

    Attributes:
        intrinsics: Intrinsics of both rectified cameras.
        baseline: Distance of the right camera to the right of the left one, m.

    Raises:
        OpenArmError: BAD_IMAGE, when the cameras do not make a rectified pair, saying why.
    """

    def __init__(self, left: Rectified, right: Rectified) -> None:
        size, other = ((k.width, k.height) for k in (left.lens.intrinsics, right.lens.intrinsics))
        if size != other:
            raise _no_pair(f"the right image is {other[0]}x{other[1]}, the left {size[0]}x{size[1]}")
        P = left.P
        self.intrinsics = Intrinsics(*size, *(float(v) for v in (P[0, 0], P[1, 1], P[0, 2], P[1, 2])))
        if fault := self.intrinsics.fault():
            raise _no_pair(f"the left camera is not calibrated: {fault}")
        for side, camera in (("left", left), ("right", right)):
            if not (np.isfinite(camera.P).all() and np.abs(camera.R @ camera.R.T - np.eye(3)).max() < 1e-3):
                raise _no_pair(f"P or R of the {side} camera is not finite, or R is no rotation")
        if np.abs(P[:, :3] - right.P[:, :3]).max() > _SAME_PX:
            raise _no_pair(
                f"K in P is {np.round(P[:, :3], 3).tolist()} of the left and {np.round(right.P[:, :3], 3).tolist()} of"
                " the right, expected the same"
            )
        self.baseline = float(P[0, 3] - right.P[0, 3]) / self.intrinsics.fx
        if not _BASELINES[0] <= self.baseline <= _BASELINES[1]:
            raise _no_pair(
                f"the baseline is {self.baseline:g} m by P of the right camera (P[3] = -fx × baseline), expected"
                f" {_BASELINES[0]:g} .. {_BASELINES[1]:g} m; are left and right exchanged, or is it no stereo pair?"
            )
        if abs(P[1, 3] - right.P[1, 3]) > 1e-6 * self.intrinsics.fx:
            raise _no_pair("one camera is above the other by P; expected the right one to the right of the left one")
        try:
            self._maps = left.maps(), right.maps()
        except cv2.error as error:
            raise _no_pair(f"OpenCV does not rectify it: {error}") from error

    @classmethod
    def from_pose(cls, left: Lens, right: Lens, T_left_right: Array) -> Self:
        """Rectify two cameras whose relative pose is known (Bouguet's algorithm, `cv2.stereoRectify`).

        Args:
            left: Lens of the left camera.
            right: Lens of the right camera.
            T_left_right: Optical frame of the right camera in that of the left, (4, 4), m.

        Raises:
            OpenArmError: BAD_IMAGE, when they do not make a pair that can be rectified.
        """
        size, other = ((k.width, k.height) for k in (left.intrinsics, right.intrinsics))
        if left.fisheye != right.fisheye or size != other:
            raise _no_pair("one lens is a fisheye and the other is not, or their images differ in size")
        T_right_left = se3.inverse(T_left_right)
        K_left, K_right = left.intrinsics.matrix, right.intrinsics.matrix
        given = (K_left, left.d, K_right, right.d, size, T_right_left[:3, :3], T_right_left[:3, 3])
        try:
            if left.fisheye:
                found = cv2.fisheye.stereoRectify(*given, flags=cv2.CALIB_ZERO_DISPARITY)
            else:
                found = cv2.stereoRectify(*given, flags=cv2.CALIB_ZERO_DISPARITY, alpha=0)
        except cv2.error as error:
            raise _no_pair(f"OpenCV does not rectify it: {error}") from error
        R_left, R_right, P_left, P_right = (np.asarray(part, np.float64) for part in found[:4])
        return cls(Rectified(left, R_left, P_left), Rectified(right, R_right, P_right))

    @property
    def ready(self) -> bool:
        """Whether the images are rectified as they come."""
        return self._maps == (None, None)

    def rectify(self, left: Bytes, right: Bytes) -> tuple[Bytes, Bytes]:
        """Return the rectified images (h, w) or (h, w, 3), black where the camera does not see.

        Raises:
            OpenArmError: BAD_IMAGE, for an image of another size than its camera's.
        """
        check_size("left image", left.shape, self.intrinsics)
        check_size("right image", right.shape, self.intrinsics)
        return _remapped(left, self._maps[0]), _remapped(right, self._maps[1])


def _remapped(image: Bytes, maps: tuple[Map, Map] | None) -> Bytes:
    return image if maps is None else np.asarray(cv2.remap(image, *maps, cv2.INTER_LINEAR), np.uint8)


def _no_pair(text: str) -> OpenArmError:
    return OpenArmError(Code.BAD_IMAGE, f"not a rectified stereo pair: {text}")
