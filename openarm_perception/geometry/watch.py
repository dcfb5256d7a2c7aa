# SPDX-License-Identifier: Apache-2.0
"""Does a camera see what it should: intrinsics as calibrated, the table where it is expected? Usable without ROS.

Intrinsics are compared with those that the mount was calibrated with; without a record of these, only loosely with the
configuration. The table is measured now and then. What it cannot show: a principal point that is off along the table's
level lines, and a focal length seen from straight above; the comparison notices these.
"""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_perception.geometry.table import measure_table

#: Pixels that the table is measured by: a tilt to 0.1 deg with the noise of a D435, in 5 ms.
_PIXELS = 5000


class WatchConfig(Config):
    """When the images of a camera are not trusted."""

    enabled: bool = Field(default=True, description="compare intrinsics and table with what is expected")
    pixels: float = Field(
        default=5.0, gt=0.0, le=100.0, description="most that intrinsics may differ from the calibration's, pixels"
    )
    uncalibrated_pixels: float = Field(
        default=32.0, gt=0.0, le=1000.0, description="the same from cameras.yaml, where no calibration has a record"
    )
    height: float = Field(default=0.012, gt=0.0, le=0.1, description="most that the height of the table may be off, m")
    tilt_deg: float = Field(default=1.4, gt=0.0, le=20.0, description="most that the table may seem tilted, deg")
    share: float = Field(
        default=0.3, gt=0.0, le=1.0, description="of what is seen that must be table, or it counts not"
    )
    frames: int = Field(default=3, ge=1, le=100, description="frames in a row that are an alarm")
    period: float = Field(default=1.0, ge=0.0, le=60.0, description="between looks at a table that is right, s")


@dataclass
class _Suspicion:
    """What is wrong, and in how many frames in a row."""

    fault: OpenArmError | None = None
    count: int = 0

    def note(self, fault: OpenArmError | None) -> None:
        self.fault, self.count = fault, self.count + 1 if fault else 0


class CameraWatch:
    """Watches one camera, frame by frame.

    Args:
        config: When images are not trusted.
        limits: Depths that count.
        configured: Intrinsics of the configuration.
    """

    def __init__(self, config: WatchConfig, limits: DepthLimits, configured: Intrinsics) -> None:
        self._config, self._limits, self._configured = config, limits, configured
        #: Intrinsics that the mount was calibrated with; None: there is no record of them.
        self.calibrated: Intrinsics | None = None
        self._optics, self._table = _Suspicion(), _Suspicion()
        self._looked_ns: int | None = None

    @property
    def alarm(self) -> OpenArmError | None:
        """What has been wrong in so many frames that it is certain."""
        certain = (s.fault for s in (self._optics, self._table) if s.count >= self._config.frames)
        return next((fault for fault in certain if fault is not None), None)

    def look(self, t_ns: int, view: View, table_height: float) -> OpenArmError | None:
        """Return why no object of a frame may be a target; None when nothing speaks against it.

        Args:
            t_ns: Stamp of the frame.
            view: The frame.
            table_height: Height that is expected, base frame, m.

        Returns:
            INTRINSICS_MISMATCH or TABLE_MISMATCH once it is certain; NOTHING_DETECTED before, when the next frames may
            be better.

        Raises:
            OpenArmError: BAD_IMAGE, when depth and intrinsics do not fit.
        """
        if not self._config.enabled:
            return None
        self._optics.note(self._compare(view.intrinsics))
        if self._due(t_ns):
            self._looked_ns = t_ns
            with contextlib.suppress(_NotSeenError):
                self._table.note(self._measure(view, table_height))
        fault = self.alarm or self._optics.fault or self._table.fault
        if fault is None or fault is self.alarm:
            return fault
        return OpenArmError(Code.NOTHING_DETECTED, f"{fault.message} This may have been one frame; the next will tell.")

    def _due(self, t_ns: int) -> bool:
        if self._looked_ns is None or self._table.fault is not None or t_ns < self._looked_ns:
            return True
        return t_ns - self._looked_ns >= round(self._config.period * 1e9)

    def _compare(self, given: Intrinsics) -> OpenArmError | None:
        known, most = self._configured, self._config.uncalibrated_pixels
        whose = "cameras.yaml says; calibrate the camera, or correct its fovy_deg there."
        if self.calibrated is not None:
            known, most = self.calibrated, self._config.pixels
            whose = "its mount was calibrated with; correct what the driver publishes, or calibrate again."
        # another resolution has other intrinsics: the table has to do
        off = _largest_shift(known, given) if (known.width, known.height) == (given.width, given.height) else 0.0
        if off <= most:
            return None
        return OpenArmError(
            Code.INTRINSICS_MISMATCH,
            f"camera_info ({_text(given)}) is up to {off:.0f} pixels off ({_text(known)}) that {whose} Allowed are"
            f" {most:g} pixels.",
        )

    def _measure(self, view: View, expected: float) -> OpenArmError | None:
        """Return what is wrong with the table.

        Raises:
            _NotSeenError: When too little of it is in view.
        """
        try:
            table = measure_table(view, self._limits, expected, _PIXELS)
        except OpenArmError as error:
            if error.code is not Code.NOTHING_DETECTED:
                raise
            raise _NotSeenError from error
        if table.share < self._config.share:
            raise _NotSeenError
        tilt, off = math.degrees(table.tilt), table.height - expected
        if tilt > self._config.tilt_deg:
            return OpenArmError(
                Code.INTRINSICS_MISMATCH,
                f"the table seems tilted by {tilt:.1f} deg, expected at most {self._config.tilt_deg:g}: intrinsics or"
                " mount of the camera are wrong; compare camera_info with the calibration, or calibrate again.",
            )
        if abs(off) > self._config.height:
            return OpenArmError(
                Code.TABLE_MISMATCH,
                f"the table is seen at {table.height:.3f} m, {off * 1e3:+.0f} mm from where it is expected; allowed are"
                f" {self._config.height * 1e3:.0f} mm. If it is there, store that with `openarm calibrate table`; else"
                " calibrate the camera.",
            )
        return None


class _NotSeenError(Exception):
    """Too little of the table is in view to say anything of it."""


def _largest_shift(a: Intrinsics, b: Intrinsics) -> float:
    """Return how far apart two cameras see the same ray at most, pixels; at a corner of the image of the first."""
    corners = np.array([(u, v) for u in (0.0, a.width - 1.0) for v in (0.0, a.height - 1.0)])
    return float(np.linalg.norm(b.project(a.deproject(corners, np.ones(4))) - corners, axis=1).max())


def _text(k: Intrinsics) -> str:
    return f"fx {k.fx:.1f}, fy {k.fy:.1f}, cx {k.cx:.1f}, cy {k.cy:.1f}"
