# SPDX-License-Identifier: Apache-2.0
"""A RealSense in software: the library's own device, into which a test puts frames."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from openarm_hardware.cameras.realsense import library

WIDTH, HEIGHT, RATE = 64, 48, 30
#: Of colour and of depth, which sees less, so that alignment has something to do.
COLOR_F, DEPTH_F = 60.0, 80.0


class SoftwareRealSense:
    """Two sensors, colour (RGB8) and depth (Z16), and an IMU."""

    def __init__(
        self,
        serial: str = "123456",
        coefficients: tuple[float, ...] = (0.0,) * 5,
        unit: float = 0.001,
        place: tuple[float, float, float] = (0.0, 0.0, 0.0),
        optics: Any = None,
    ) -> None:
        """Make a device; `optics` are intrinsics of the library of both streams, depth's without distortion."""
        self.rs = rs = library()
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software D435I")
        self.device.register_info(rs.camera_info.serial_number, serial)
        self._color, self._depth = (self.device.add_sensor(name) for name in ("Color", "Stereo"))
        self._motion = self.device.add_sensor("Motion")
        seen = optics or self._optics(COLOR_F, coefficients)
        plain = self._optics(DEPTH_F, (0.0,) * 5)
        if optics is not None:
            for name in ("width", "height", "fx", "fy", "ppx", "ppy"):
                setattr(plain, name, getattr(optics, name))
        self.color = self._video(self._color, rs.stream.color, 1, rs.format.rgb8, 3, seen)
        self.depth = self._video(self._depth, rs.stream.depth, 0, rs.format.z16, 2, plain)
        self._depth.add_read_only_option(rs.option.depth_units, unit)
        self.unit = unit
        # of the depth camera, from the colour camera
        self.color.register_extrinsics_to(self.depth, self._pose([-v for v in place]))
        self.depth.register_extrinsics_to(self.color, self._pose(list(place)))
        self.gyro, self.accel = (
            self._axes(kind, index) for index, kind in enumerate((rs.stream.gyro, rs.stream.accel))
        )
        self.device.create_matcher(rs.matchers.dlr_c)
        self.number, self.t_ns = 0, time.time_ns()

    def show(self, color: np.ndarray, depth: np.ndarray, t_ns: int = 0) -> None:
        """Let the camera see a picture (h, w, 3) and distances (h, w), in its own steps, at a time."""
        self.number += 1
        self.t_ns += round(1e9 / RATE)  # evenly, or the library does not match them
        t_ns = t_ns or self.t_ns
        for sensor, profile, pixels in ((self._depth, self.depth, depth), (self._color, self.color, color)):
            frame = self.rs.software_video_frame()
            frame.pixels = np.ascontiguousarray(pixels).reshape(-1).view(np.uint8)
            frame.bpp = pixels.itemsize * (3 if pixels.ndim == 3 else 1)
            frame.stride = pixels.shape[1] * frame.bpp
            self._stamp(frame, profile, t_ns)
            if profile is self.depth:
                frame.depth_units = self.unit
            sensor.on_video_frame(frame)

    def turn(self, gyro: tuple[float, float, float], accel: tuple[float, float, float], t_ns: int = 0) -> None:
        """Let the IMU measure."""
        for profile, value in ((self.accel, accel), (self.gyro, gyro)):
            frame = self.rs.software_motion_frame()
            data = self.rs.vector()
            data.x, data.y, data.z = value
            frame.data = data
            self._stamp(frame, profile, t_ns)
            self._motion.on_motion_frame(frame)

    def _stamp(self, frame: Any, profile: Any, t_ns: int) -> None:
        frame.timestamp = (t_ns or self.t_ns) * 1e-6
        frame.domain = self.rs.timestamp_domain.system_time
        frame.frame_number = self.number
        frame.profile = profile

    def _optics(self, f: float, coefficients: tuple[float, ...]) -> Any:
        rs = self.rs
        optics = rs.intrinsics()
        optics.width, optics.height, optics.fx, optics.fy = WIDTH, HEIGHT, f, f
        optics.ppx, optics.ppy = (WIDTH - 1) / 2.0, (HEIGHT - 1) / 2.0
        optics.model, optics.coeffs = rs.distortion.inverse_brown_conrady, list(coefficients)
        return optics

    def _video(self, sensor: Any, kind: Any, uid: int, form: Any, bpp: int, optics: Any) -> Any:
        stream = self.rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt, stream.bpp = kind, 0, uid, form, bpp
        stream.width, stream.height, stream.fps, stream.intrinsics = optics.width, optics.height, RATE, optics
        return sensor.add_video_stream(stream).as_video_stream_profile()

    def _axes(self, kind: Any, index: int) -> Any:
        stream = self.rs.motion_stream()
        stream.type, stream.index, stream.uid, stream.fps = kind, 0, 2 + index, 200
        stream.fmt = self.rs.format.motion_xyz32f
        return self._motion.add_motion_stream(stream).as_motion_stream_profile()

    def _pose(self, place: list[float]) -> Any:
        pose = self.rs.extrinsics()
        pose.rotation, pose.translation = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], place
        return pose
