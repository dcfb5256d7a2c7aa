# SPDX-License-Identifier: Apache-2.0
"""A RealSense by pyrealsense2: colour, depth aligned to it, IMU."""

from __future__ import annotations

import ctypes
import time
from collections.abc import Callable, Iterable, Iterator
from typing import Any

import numpy as np

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens, lens_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_hardware.cameras.config import RealsenseConfig
from openarm_hardware.cameras.source import CameraFrame, ImuReading

_INSTALL = "install the extra `realsense`: .venv/bin/uv pip install --require-hashes -r requirements-realsense.lock"


def library() -> Any:
    """Return the module pyrealsense2, with the libusb of the package libusb-package where the system has none.

    Raises:
        OpenArmError: ENVIRONMENT, saying what to install.
    """
    try:
        ctypes.CDLL("libusb-1.0.so.0", mode=ctypes.RTLD_GLOBAL)
    except OSError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
        except (ImportError, OSError) as error:
            raise OpenArmError(Code.ENVIRONMENT, f"there is no libusb-1.0 for RealSense cameras; {_INSTALL}") from error
    try:
        import pyrealsense2
    except ImportError as error:
        raise OpenArmError(Code.ENVIRONMENT, f"pyrealsense2 can't be imported ({error}); {_INSTALL}") from error
    return pyrealsense2


class RealSense:
    """See `CameraSource`.

    Args:
        config: Camera and its streams.
        devices: Lists devices; those that are plugged in when not given.
    """

    has_depth = True

    def __init__(self, config: RealsenseConfig, devices: Callable[[], Iterable[Any]] | None = None) -> None:
        self._rs = library()
        self._config = config
        self._devices = devices or (lambda: self._rs.context().query_devices())
        self._device: Any = None
        self._open: list[Any] = []
        self._turns = self._rs.frame_queue(400)
        self._acceleration: Array | None = None

    @property
    def intrinsics(self) -> Intrinsics:
        """See `CameraSource.intrinsics`."""
        return self._lens.intrinsics

    def open(self) -> str:
        """See `CameraSource.open`."""
        rs, config = self._rs, self._config
        try:
            self._device = device = self._found()
            color = self._profile(rs.stream.color, (rs.format.rgb8, rs.format.bgr8))
            depth = self._profile(rs.stream.depth, (rs.format.z16,))
            self._swapped = color[1].format() == rs.format.bgr8
            self._lens = lens_of_librealsense(color[1].as_video_stream_profile().get_intrinsics())
            self._millimetres = 1e3 * self._depth_unit(depth[0])
            self._align, self._frames = rs.align(rs.stream.color), rs.syncer(2)
            for sensor, profiles in _by_sensor((color, depth)):
                sensor.open(profiles)
                self._open.append(sensor)
                sensor.start(self._frames)
            self._start_imu()
            name, serial = (device.get_info(key) for key in (rs.camera_info.name, rs.camera_info.serial_number))
            speed = rs.camera_info.usb_type_descriptor
            usb = f", USB {device.get_info(speed)}" if device.supports(speed) else ""
        except RuntimeError as error:  # of the library
            raise OpenArmError(Code.NOT_READY, f"RealSense {config.serial or 'camera'}: {error}") from error
        return f"{name} {serial}{usb}"

    def read(self, seconds: float) -> CameraFrame | None:
        """See `CameraSource.read`."""
        rs = self._rs
        try:
            if not self._device.is_connected():
                raise OpenArmError(Code.NOT_READY, "the RealSense was unplugged")
            frames = self._pair(seconds)
            if frames is None:
                return None
            color = frames.get_color_frame()
            t_ns = _stamp_ns(rs, color)
            aligned = self._align.process(frames).get_depth_frame()
            pixels = np.asanyarray(color.get_data())
            distances = np.asanyarray(aligned.get_data())
        except RuntimeError as error:
            raise OpenArmError(Code.NOT_READY, f"the RealSense does not answer: {error}") from error
        if self._swapped:
            pixels = pixels[..., ::-1]
        if abs(self._millimetres - 1.0) > 1e-6:
            distances = np.minimum(np.rint(distances * self._millimetres), 65535.0).astype(np.uint16)
        picture = self._lens.rectified(np.ascontiguousarray(pixels))
        return CameraFrame(t_ns, picture, self._lens.rectified_depth(distances), tuple(self._imu_readings()))

    def close(self) -> None:
        """See `CameraSource.close`."""
        for sensor in self._open:
            try:
                sensor.stop()
                sensor.close()
            except RuntimeError:  # of a device that is gone
                continue
        self._open.clear()
        self._device = None

    def _pair(self, seconds: float) -> Any:
        """Return the next frames of colour and depth of one time; None when there were none."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0.0:
            good, frames = self._frames.try_wait_for_frames(max(1, round(left * 1e3)))
            if good and frames.get_color_frame() and frames.get_depth_frame():
                return frames
        return None

    def _found(self) -> Any:
        rs, serial = self._rs, self._config.serial
        devices = {d.get_info(rs.camera_info.serial_number): d for d in self._devices()}
        there = ", ".join(f"{d.get_info(rs.camera_info.name)} {number}" for number, d in devices.items()) or "none"
        if serial in devices:
            return devices[serial]
        if not serial and len(devices) == 1:
            return next(iter(devices.values()))
        wanted = f"no RealSense has the serial number {serial}" if serial else "name the RealSense by its serial number"
        if not devices:
            wanted = "no RealSense is plugged in, or this user may not open it (`openarm doctor`)"
        raise OpenArmError(Code.NOT_READY, f"{wanted}; there are: {there}")

    def _profile(self, stream: Any, formats: tuple[Any, ...]) -> tuple[Any, Any]:
        """Return sensor and profile of a stream."""
        config, there = self._config, set[str]()
        found = dict[int, tuple[Any, Any]]()
        for sensor in self._device.query_sensors():
            for profile in sensor.get_stream_profiles():
                if profile.stream_type() != stream or not profile.is_video_stream_profile():
                    continue
                video = profile.as_video_stream_profile()
                there.add(f"{video.width()}x{video.height()} at {profile.fps()} Hz")
                size = (video.width(), video.height(), profile.fps())
                if profile.format() in formats and size == (config.width, config.height, round(config.rate)):
                    found.setdefault(formats.index(profile.format()), (sensor, profile))
        if not found:
            asked = f"{config.width}x{config.height} at {config.rate:g} Hz"
            text = f"the RealSense gives no {stream} of {asked}; it gives {', '.join(sorted(there)) or 'none'}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        return found[min(found)]

    def _depth_unit(self, sensor: Any) -> float:
        """Return m of one step of depth."""
        option = self._rs.option.depth_units
        return float(sensor.get_option(option)) if sensor.supports(option) else 0.001

    def _start_imu(self) -> None:
        rs = self._rs
        if not self._config.imu:
            return
        for sensor in self._device.query_sensors():
            motion = [p for p in sensor.get_stream_profiles() if p.stream_type() in (rs.stream.gyro, rs.stream.accel)]
            # the slowest of each: what they are for is gravity and whether the camera moves
            best = {kind: min((p for p in motion if p.stream_type() == kind), key=lambda p: p.fps(), default=None)
                    for kind in (rs.stream.gyro, rs.stream.accel)}  # fmt: skip
            if None not in best.values() and sensor not in self._open:
                sensor.open(list(best.values()))
                self._open.append(sensor)
                sensor.start(self._turns)

    def _imu_readings(self) -> Iterator[ImuReading]:
        """Yield what the IMU has measured: each angular velocity with the newest acceleration."""
        rs = self._rs
        while frame := self._turns.poll_for_frame():
            motion = frame.as_motion_frame()
            data = motion.get_motion_data()
            value = np.array([data.x, data.y, data.z])
            if motion.get_profile().stream_type() == rs.stream.accel:
                self._acceleration = value
            elif self._acceleration is not None:
                yield ImuReading(_stamp_ns(rs, motion), value, self._acceleration)


def lens_of_librealsense(optics: Any) -> Lens:
    """Return the lens of `rs2_intrinsics`.

    Raises:
        OpenArmError: BAD_IMAGE, for a model that has no picture without distortion.
    """
    k = (optics.fx, 0.0, optics.ppx, 0.0, optics.fy, optics.ppy, 0.0, 0.0, 1.0)
    return lens_of((optics.width, optics.height), k, optics.model.name, optics.coeffs, "the RealSense")


def _by_sensor(chosen: tuple[tuple[Any, Any], ...]) -> list[tuple[Any, list[Any]]]:
    """Return each sensor with its profiles: one sensor may have several streams, and is opened once."""
    found = list[tuple[Any, list[Any]]]()
    for sensor, profile in chosen:
        same = next((profiles for other, profiles in found if other.name == sensor.name), None)
        if same is None:
            found.append((sensor, [profile]))
        else:
            same.append(profile)
    return found


def _stamp_ns(rs: Any, frame: Any) -> int:
    """Return the wall clock of a frame; where the device's clock is not brought to it, that of its arrival."""
    domain = frame.get_frame_timestamp_domain()
    if domain in (rs.timestamp_domain.global_time, rs.timestamp_domain.system_time):
        return round(frame.get_timestamp() * 1e6)
    return time.time_ns()
