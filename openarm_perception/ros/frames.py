# SPDX-License-Identifier: Apache-2.0
"""Frames of a depth camera from the topics that drivers publish."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import depth_image, rgb_image, stamp_to_ns
from openarm_perception.frames.images import Frame, rectified
from openarm_perception.geometry.depth import Deprojector, DepthLimits

_COLOR, _INFO = "/color/image_raw", "/color/camera_info"
#: Depth that is aligned with the colour image, as RealSense drivers and this suite call it.
_DEPTH = ("/aligned_depth_to_color/image_raw", "/depth/image_raw")
#: Colour and depth of one frame differ by no more, ns.
_TOGETHER = 20_000_000


class CameraTopics(NamedTuple):
    """Topics of a depth camera."""

    color: str
    depth: str
    info: str


def camera_topics(names: Collection[str], camera: str = "") -> CameraTopics:
    """Choose the topics of a camera among those that there are.

    Args:
        names: Of topics.
        camera: Namespace, such as `/camera/camera`, or a part of one; "": the only camera.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there is no such camera; INVALID_ARGUMENT, when there are several.
    """
    found: dict[str, CameraTopics] = {}
    for name in sorted(names):
        space = name.removesuffix(_COLOR)
        depth = next((space + end for end in _DEPTH if space + end in names), "")
        if name.endswith(_COLOR) and depth and space + _INFO in names:
            found[space] = CameraTopics(name, depth, space + _INFO)
    wanted = f"/{camera.strip('/')}"
    chosen = [wanted] if wanted in found else [space for space in found if camera.strip("/") in space]
    listed = ", ".join(found) or "none"
    if not chosen:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"no depth camera {camera or 'at all'!r}: expected topics that end in {_COLOR}, {_INFO} and {_DEPTH[0]} (or"
            f" {_DEPTH[1]}); cameras: {listed}",
        )
    if len(chosen) > 1:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"several cameras: {', '.join(chosen)}; choose one with --camera")
    return found[chosen[0]]


class FrameBuilder:
    """Puts the messages of a camera together: colour and depth of the same time, and the newest intrinsics.

    Args:
        topics: Of the camera.
        limits: Depths that count.
        depth_scale: Metres of a count of a depth image of integers; 0.001 is that of ROS.
    """

    def __init__(self, topics: CameraTopics, limits: DepthLimits, depth_scale: float = 0.001) -> None:
        self._topics, self._limits, self._scale = topics, limits, depth_scale
        self._newest: dict[str, Any] = {}

    def take(self, topic: str, message: Image | CameraInfo) -> Frame | None:
        """Take a message; returns a frame when it completes one.

        Raises:
            OpenArmError: BAD_IMAGE, when colour, depth and camera_info do not belong together or cannot be read.
        """
        self._newest[topic] = message
        color, depth = self._newest.get(self._topics.color), self._newest.get(self._topics.depth)
        info = self._newest.get(self._topics.info)
        if color is None or depth is None or info is None:
            return None
        if abs(stamp_to_ns(color.header.stamp) - stamp_to_ns(depth.header.stamp)) > _TOGETHER:
            return None
        return frame_of(color, depth, info, self._limits, self._scale)

    def missing(self) -> str:
        """What has not come, for an error."""
        absent = [topic for topic in self._topics if topic not in self._newest]
        return f"nothing on {', '.join(absent)}" if absent else "no colour and depth image of the same time"


def frame_of(color: Image, depth: Image, info: CameraInfo, limits: DepthLimits, depth_scale: float = 0.001) -> Frame:
    """Make a frame of aligned images; distortion is removed.

    Args:
        color: 8 bits, rgb8 or bgr8.
        depth: 16UC1 counts, or 32FC1 metres.
        info: Of both.
        limits: Depths that count.
        depth_scale: Metres of a count.

    Raises:
        OpenArmError: BAD_IMAGE, when they do not belong together or cannot be read.
    """
    k = info.k
    lens = Intrinsics(info.width, info.height, k[0], k[4], k[2], k[5])
    if fault := lens.fault():
        raise OpenArmError(Code.BAD_IMAGE, f"camera_info of {info.header.frame_id!r} is not calibrated: {fault}")
    rgb, counts = rgb_image(color), depth_image(depth)
    for name, shape in (("colour", rgb.shape), ("depth", counts.shape)):
        if shape[:2] != (lens.height, lens.width):
            text = (
                f"the {name} image is {shape[1]}x{shape[0]} pixels, expected {lens.width}x{lens.height} of camera_info"
            )
            raise OpenArmError(Code.BAD_IMAGE, text)
    z = counts.astype(np.float32) * np.float32(depth_scale if counts.dtype == np.uint16 else 1.0)
    if any(value != 0.0 for value in info.d):
        rgb, z = rectified(rgb, z, lens, np.asarray(info.d, dtype=np.float64), info.distortion_model)
    return Frame(Deprojector(limits).organised(z, lens), np.ascontiguousarray(rgb), lens)
