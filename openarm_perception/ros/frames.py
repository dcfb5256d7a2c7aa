# SPDX-License-Identifier: Apache-2.0
"""Frames of a depth camera from the topics that drivers publish."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from sensor_msgs.msg import CameraInfo

from openarm_common import se3
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.images import (
    AnyImage,
    color_of,
    depth_image,
    is_rectified,
    lens_from_info,
    rotation_from_info,
)
from openarm_common.types import Array
from openarm_perception.frames.images import Frame, assumed, metres
from openarm_perception.geometry.align import aligned
from openarm_perception.geometry.depth import Deprojector, DepthLimits

IMAGE, COMPRESSED, INFO = (f"sensor_msgs/msg/{kind}" for kind in ("Image", "CompressedImage", "CameraInfo"))
#: Ends of topics of colour and of depth, of drivers of RealSense, ZED, OAK, Kinect, Orbbec and of simulations; those
#: that are rectified, or aligned with colour, first.
_COLOR = (
    "color/image_rect", "color/image_raw", "color/image_rect_raw", "rgb/image_rect_color", "rgb/image_rect",
    "rgb/color/rect/image", "rgb/image_raw", "rgb/image_color", "rgb/image", "left/color/rect/image",
    "left/image_rect_color", "left/image_rect", "image_rect_color", "image_raw", "image_color", "image",
)  # fmt: skip
_DEPTH = (
    "aligned_depth_to_color/image_raw", "depth_to_rgb/image_raw", "depth_registered/image_raw",
    "depth_registered/image_rect", "depth_registered/image", "depth/depth_registered", "stereo/image_raw",
    "depth/image_rect", "depth/image_raw", "depth/image_rect_raw", "depth/image", "depth_image", "depth",
)  # fmt: skip
#: What image_transport adds to a topic.
_TRANSPORTS = ("", "/compressed", "/compressedDepth")
#: Names of depth that lies on the colour image already, whatever its frame is called.
_REGISTERED = re.compile(r"registered|aligned_depth|depth_to_(color|rgb)")
#: Colour and depth of one frame differ by no more: two images at 15 Hz that are not triggered together, ns.
_TOGETHER = 35_000_000
#: Intrinsics of the same image differ by no more, px.
_SAME_PX = 0.5
#: Frames that are tried, where the first ones can't be read.
_FAULTS = 30


@dataclass(frozen=True)
class CameraChoice:
    """Which camera, and what its topics and their names do not say.

    Attributes:
        camera: Namespace, such as `/camera/camera`, or a part of one; "": the only camera.
        color: Topic of the colour image; "": by the names that drivers use.
        depth: Topic of the depth image, likewise.
        info: Topic of the CameraInfo of the colour image, likewise.
        lens: Lens of the colour camera; None: by its CameraInfo.
        depth_scale: Metres of a count of depth; None as for `metres`.
        rectified: Whether the images are without distortion, whatever their CameraInfo says; auto: by their names.
        registered: Whether depth lies on the pixels of colour, whatever its frame is called; auto: by its name.
    """

    camera: str = ""
    color: str = ""
    depth: str = ""
    info: str = ""
    lens: Lens | None = None
    depth_scale: float | None = None
    rectified: Literal["auto", "yes", "no"] = "auto"
    registered: Literal["auto", "yes", "no"] = "auto"


ONLY = CameraChoice()


class CameraTopics(NamedTuple):
    """Topics of a depth camera; `depth_info` is empty where the depth has no CameraInfo of its own."""

    color: str
    depth: str
    info: str
    depth_info: str = ""


def camera_topics(kinds: Mapping[str, str], chosen: CameraChoice = ONLY, *, known: bool = False) -> CameraTopics:
    """Choose the topics of a camera among those that there are.

    Args:
        kinds: Type by topic.
        chosen: Choice of the camera.
        known: Whether no CameraInfo of the colour image is needed, as where its lens is given.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there is no such camera; INVALID_ARGUMENT, when there are several, or a
            topic is missing or of another type.
    """
    camera, color, depth, info = chosen.camera, chosen.color, chosen.depth, chosen.info
    known = known or chosen.lens is not None
    for option, topic, types in (
        ("--color", color, (IMAGE, COMPRESSED)), ("--depth", depth, (IMAGE, COMPRESSED)), ("--info", info, (INFO,)),
    ):  # fmt: skip
        if topic and kinds.get(topic) not in types:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{option} {topic} is no topic with {' or '.join(types)}; {_listed(kinds)}"
            )
    if color and depth:
        return _with_infos(CameraTopics(color, depth, info), kinds, fail=not known)
    cameras = {
        space: _with_infos(CameraTopics(color or its_color, depth or its_depth, info), kinds, fail=False)
        for space in sorted({space for end in (*_COLOR, *_DEPTH) for space in _spaces(kinds, end)})
        if (its_color := color or _first(kinds, space, _COLOR)) and (its_depth := depth or _first(kinds, space, _DEPTH))
    }
    lacking = [topics for topics in cameras.values() if not (topics.info or known)]
    cameras = {space: topics for space, topics in cameras.items() if topics.info or known}
    part = camera.strip("/")
    fitting = [f"/{part}"] if f"/{part}" in cameras else [space for space in cameras if part in space]
    if len({cameras[space] for space in fitting}) == 1:
        return cameras[fitting[0]]
    if fitting:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"several cameras: {', '.join(fitting)}; choose one by --camera, or topics by --color",
        )
    if lacking:
        _with_infos(lacking[0], kinds)  # says what is missing
    what = f"no depth camera {camera!r}" if camera else "no depth camera"
    raise OpenArmError(
        Code.NOTHING_DETECTED,
        f"{what} with the names that drivers use; cameras: {', '.join(cameras) or 'none'}; choose topics by --color,"
        f" --depth and --info; {_listed(kinds)}",
    )


def _listed(kinds: Mapping[str, str]) -> str:
    images = [topic for topic, kind in sorted(kinds.items()) if kind in (IMAGE, COMPRESSED)]
    infos = [topic for topic, kind in sorted(kinds.items()) if kind == INFO]
    if clouds := [topic for topic, kind in sorted(kinds.items()) if kind == "sensor_msgs/msg/PointCloud2"]:
        infos.append(f"(clouds, which are read from files alone: {', '.join(clouds)})")
    return f"image topics: {', '.join(images) or 'none'}; camera_info topics: {', '.join(infos) or 'none'}"


def _spaces(kinds: Mapping[str, str], end: str) -> list[str]:
    ends = [f"/{end}{transport}" for transport in _TRANSPORTS]
    return [topic.removesuffix(one) for one in ends for topic in kinds if topic.endswith(one)]


def _first(kinds: Mapping[str, str], space: str, ends: tuple[str, ...]) -> str:
    """Return the first topic of a namespace that has images; "" without."""
    names = (f"{space}/{end}{transport}" for end in ends for transport in _TRANSPORTS)
    return next((name for name in names if kinds.get(name) in (IMAGE, COMPRESSED)), "")


def _with_infos(topics: CameraTopics, kinds: Mapping[str, str], *, fail: bool = True) -> CameraTopics:
    """Return topics with the CameraInfo next to each image.

    Raises:
        OpenArmError: NOTHING_DETECTED, when the colour image has none.
    """

    def of(image: str) -> str:
        name = _untransported(image).rpartition("/")[0] + "/camera_info"
        return name if kinds.get(name) == INFO else ""

    info = topics.info or of(topics.color)
    if not info and fail:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"no camera_info next to {topics.color}; give its topic, or a file of its intrinsics, by --info;"
            f" {_listed(kinds)}",
        )
    own = of(topics.depth)
    return topics._replace(info=info, depth_info="" if own == info else own)


def _untransported(topic: str) -> str:
    return topic.removesuffix("/compressed").removesuffix("/compressedDepth")


class FrameBuilder:
    """Puts the messages of a camera together: colour and depth of the same time, and the newest intrinsics.

    Args:
        topics: Topics of the camera.
        limits: Depths that count.
        chosen: Settings that the topics do not give.
        pose: Returns the pose (4, 4) of the second frame in the first one; None, when it is not known.

    Attributes:
        faults: Why frames could not be read: later ones may be whole.
    """

    def __init__(
        self,
        topics: CameraTopics,
        limits: DepthLimits,
        chosen: CameraChoice = ONLY,
        pose: Callable[[str, str], Array | None] = lambda _target, _source: None,
    ) -> None:
        self._topics, self._limits, self._chosen, self._pose = topics, limits, chosen, pose
        self.faults: list[OpenArmError] = []
        self._newest: dict[str, Any] = {}
        self._nearest_ns = math.inf

    def take(self, topic: str, message: AnyImage | CameraInfo) -> Frame | None:
        """Take a message; returns a frame when it completes one.

        Raises:
            OpenArmError: BAD_IMAGE, when colour, depth and camera_info do not belong together or cannot be read.
        """
        self._newest[topic] = message
        names = self._topics
        color, depth = self._newest.get(names.color), self._newest.get(names.depth)
        if color is None or depth is None or any(name not in self._newest for name in self._wanted()):
            return None
        apart_ns = abs(stamp_to_ns(color.header.stamp) - stamp_to_ns(depth.header.stamp))
        self._nearest_ns = min(self._nearest_ns, apart_ns)
        if apart_ns > _TOGETHER:
            return None
        return self._frame(color, depth)

    def _wanted(self) -> list[str]:
        return [topic for topic in self._topics if topic and (topic != self._topics.info or self._chosen.lens is None)]

    @property
    def given_up(self) -> bool:
        """Whether so many frames could not be read that another one will not be either."""
        return len(self.faults) >= _FAULTS

    def failure(self, code: Code, text: str) -> OpenArmError:
        """Return why there is no frame: what was wrong with the first one, or a text with what has not come."""
        return self.faults[0] if self.faults else OpenArmError(code, f"{text}: {self.missing()}")

    def missing(self) -> str:
        """What has not come, for an error."""
        absent = [topic for topic in self._wanted() if topic not in self._newest]
        if absent:
            return f"nothing on {', '.join(absent)}"
        return (
            f"no colour and depth image of the same time: the nearest are {self._nearest_ns * 1e-6:.0f} ms apart,"
            f" expected {_TOGETHER * 1e-6:.0f} at most; are their clocks the same?"
        )

    def _frame(self, color: AnyImage, depth: AnyImage) -> Frame:
        """Make a frame: without distortion, and with the depth where the colour camera sees it."""
        names, chosen, counts = self._topics, self._chosen, depth_image(depth)
        seen = _Images(names.info, self._rectified(names.color))
        lens = self._lens(seen)
        registered = _REGISTERED.search(names.depth) if chosen.registered == "auto" else chosen.registered == "yes"
        info, as_color = names.depth_info, True
        if not info or (registered and counts.shape == (lens.intrinsics.height, lens.intrinsics.width)):
            info = names.info
        else:  # depth on a rectified colour image has the CameraInfo of its lens, too
            as_color = _alike(self._lens(_Images(names.info, False)), self._lens(_Images(info, False)))
        measured = _Images(info, self._rectified(names.depth) or (as_color and seen.rectified))
        of_depth = self._lens(measured)
        T_color_depth = np.eye(4) if registered else self._between(color, depth)
        if measured != seen:
            T_color_depth = se3.inverse(self._turned(seen)) @ T_color_depth @ self._turned(measured)
        z = of_depth.rectified_depth(metres(counts, chosen.depth_scale))
        on_color = np.allclose(T_color_depth, np.eye(4), atol=1e-6) and _alike(lens, of_depth)
        if not on_color:
            z = aligned(z, of_depth.intrinsics, T_color_depth, lens.intrinsics)
        points = Deprojector(self._limits).organised(z, lens.intrinsics)
        rgb = np.ascontiguousarray(color_of(color, lens))
        unit = assumed(counts, chosen.depth_scale)
        return Frame(points, rgb, lens.intrinsics, unit, of_depth if on_color else None)

    def _rectified(self, image: str) -> bool:
        return is_rectified(image) if self._chosen.rectified == "auto" else self._chosen.rectified == "yes"

    def _lens(self, view: _Images) -> Lens:
        """Return a lens: the given one of colour, or by a CameraInfo."""
        given = self._chosen.lens
        if given is not None and view.info == self._topics.info:
            return Lens(given.intrinsics) if view.rectified else given
        return lens_from_info(self._newest[view.info], rectified=view.rectified)

    def _turned(self, view: _Images) -> Array:
        """Return the pose (4, 4) of the frame of these images in that of their message.

        That is the frame of rectified images, as `image_geometry` has it; R turns it where the lens of a stereo pair is
        turned.
        """
        if view.rectified or (self._chosen.lens is not None and view.info == self._topics.info):
            return np.eye(4)
        return se3.make(rotation_from_info(self._newest[view.info]))

    def _between(self, color: AnyImage, depth: AnyImage) -> Array:
        """Return the pose (4, 4) of the depth's frame in that of colour."""
        target, source = _frame_id(color), _frame_id(depth)
        if target == source or not (target and source):
            return np.eye(4)
        where = f"{self._topics.depth} is in frame {source!r}, {self._topics.color} in {target!r}, and"
        if not self._topics.depth_info:
            raise OpenArmError(Code.BAD_IMAGE, f"{where} the depth has no camera_info; {_ALIGN}")
        pose = self._pose(target, source)
        if pose is None:
            text = f"{where} /tf_static does not tie them; {_ALIGN}; or record /tf_static, too"
            raise OpenArmError(Code.NO_TRANSFORM, text)
        return pose


class _Images(NamedTuple):
    """Topic of the CameraInfo of images, and whether they are rectified."""

    info: str
    rectified: bool


_ALIGN = (
    "take depth that the driver aligns with colour (RealSense: align_depth.enable:=true) by --depth, or type"
    " --registered yes where it lies on the pixels of colour already"
)


def _frame_id(message: Any) -> str:
    return message.header.frame_id.lstrip("/")


def _alike(a: Lens, b: Lens) -> bool:
    one, other = a.intrinsics, b.intrinsics
    return (one.width, one.height) == (other.width, other.height) and all(
        abs(getattr(one, name) - getattr(other, name)) < _SAME_PX for name in ("fx", "fy", "cx", "cy")
    )
