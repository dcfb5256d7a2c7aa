# SPDX-License-Identifier: Apache-2.0
"""What a camera gives, and what the thread that keeps one open asks of its driver."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array, Bytes


@dataclass(frozen=True, eq=False)
class ImuReading:
    """One reading of an IMU: rad/s and m/s², (3,), in the frame of the IMU."""

    t_ns: int
    gyro: Array
    acceleration: Array


@dataclass(frozen=True, eq=False)
class CameraFrame:
    """One rectified image.

    Attributes:
        t_ns: Wall clock at its exposure, by the best clock that the driver has.
        color: (h, w, 3) RGB.
        depth: (h, w) mm, 0 where there is none, aligned to `color`; None for a camera without depth.
        imu: Measurements of the IMU since the last one.
    """

    t_ns: int
    color: Bytes
    depth: NDArray[np.uint16] | None = None
    imu: tuple[ImuReading, ...] = ()


class CameraSource(Protocol):
    """A camera; used by one thread."""

    has_depth: bool

    def open(self) -> str:
        """Open the device; return what it is, in words.

        Raises:
            OpenArmError: NOT_READY, when it is not there; CONFIG_INVALID, when it can't do what it should.
        """
        ...

    @property
    def intrinsics(self) -> Intrinsics:
        """Of its pictures, once it is open."""
        ...

    def read(self, seconds: float) -> CameraFrame | None:
        """Return the next picture; None when none came in time.

        Raises:
            OpenArmError: NOT_READY, when the device is gone.
        """
        ...

    def close(self) -> None:
        """Close the device, if it is open."""
        ...
