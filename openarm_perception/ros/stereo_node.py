# SPDX-License-Identifier: Apache-2.0
"""Node `stereo_depth`: the images of a stereo pair to a depth image of its left camera.

Depth and its CameraInfo are those of a camera with depth, so `cloud`, `octomap` and `detector` take them as such. The
pair is subscribed to only while an output of the node is.
"""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import cv2
import numpy as np
from sensor_msgs.msg import CameraInfo, Image

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, depth_camera, load_cameras, stereo_pairs
from openarm_common.camera.depth_view import millimetres
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import info_from_intrinsics, stamp_to_ns
from openarm_common.ros.images import (
    array_to_image,
    is_rectified,
    lens_from_info,
    projection_from_info,
    rgb_image,
    rotation_from_info,
)
from openarm_common.ros.node import QOS_NEWEST, QOS_SENSOR, BaseNode, run
from openarm_common.types import Floats
from openarm_perception.config import StereoNodeConfig
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.stereo.matching import StereoMatcher
from openarm_perception.stereo.pairs import PairMatcher, Side
from openarm_perception.stereo.rectification import Rectification, Rectified

#: A side that is silent for so long while the other comes is reported, s.
_PATIENCE = 2.0


class StereoNode(BaseNode[StereoNodeConfig]):
    """Publishes depth of a stereo pair on demand."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("stereo_depth", StereoNodeConfig, **kwargs)
        config = self.config
        left, right = _pair(config)
        self._frames: dict[Side, str] = {"left": left.optical_frame, "right": right.optical_frame}
        self._limits = DepthLimits(near=left.near, far=left.far)
        self._T_left_right = se3.make(se3.exp_so3(np.array(config.pose[3:])), config.pose[:3]) if config.pose else None
        names = {"camera": left.name, "right": right.name}
        self._topics: dict[Side, tuple[str, str]] = {
            "left": (config.left_topic.format(**names), config.left_info_topic.format(**names)),
            "right": (config.right_topic.format(**names), config.right_info_topic.format(**names)),
        }
        self._depth = self.create_publisher(Image, config.depth_topic.format(**names), QOS_SENSOR)
        self._info = self.create_publisher(CameraInfo, config.info_topic.format(**names), QOS_SENSOR)
        self._rectified = self.create_publisher(Image, config.rectified_topic.format(**names), QOS_SENSOR)
        self._pairs: PairMatcher[Image] = PairMatcher(config.stamp_gap, config.max_rate)
        self._infos: dict[Side, CameraInfo] = {}
        #: What is computed with, and the CameraInfos that it was made of.
        self._matcher: StereoMatcher | None = None
        self._made_of: tuple[object, ...] = ()
        self._inputs: list[Any] = []
        self._heard: dict[Side, float] = {}
        self._frames_done, self._refused, self._elapsed_ms, self._valid = 0, 0, 0.0, 0.0
        self._fault = ""
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)
        self.diagnose(True, "idle: no subscribers")

    def _follow_demand(self) -> None:
        outputs = (self._depth, self._info, self._rectified)
        wanted = any(output.get_subscription_count() for output in outputs)
        if wanted and not self._inputs:
            for side, (image, info) in self._topics.items():
                take, take_info = partial(self._take, side), partial(self._take_info, side)
                self._inputs += [
                    self.create_subscription(Image, image, take, QOS_NEWEST),
                    self.create_subscription(CameraInfo, info, take_info, QOS_NEWEST),
                ]
            self._heard = {}
        elif not wanted and self._inputs:
            for subscription in self._inputs:
                self.destroy_subscription(subscription)
            self._inputs.clear()
            self._pairs.clear()
            self._infos.clear()
            self._fault = ""
        self._report()

    def _report(self) -> None:
        now = time.monotonic()
        text = "idle: no subscribers"
        if self._inputs:
            text = f"depth of {self._frames['left']}" if self._frames_done else "waiting for images of both cameras"
            for side, topics in self._topics.items():
                other: Side = "right" if side == "left" else "left"
                if now - self._heard.get(other, 0.0) < _PATIENCE and now - self._heard.get(side, 0.0) > _PATIENCE:
                    text = f"images of the {other} camera come, but none on {topics[0]}"
        counts = {f"images_{key}": n for key, n in self._pairs.counts.items()}
        self.diagnose(
            not self._fault, self._fault or text, frames=self._frames_done, refused_frames=self._refused,
            processing_ms=f"{self._elapsed_ms:.1f}", valid_percent=f"{self._valid:.1f}", **counts,
        )  # fmt: skip

    def _take_info(self, side: Side, message: CameraInfo) -> None:
        self._infos[side] = message

    def _take(self, side: Side, message: Image) -> None:
        self._heard[side] = time.monotonic()
        frame, expected = message.header.frame_id, self._frames[side]
        try:
            if frame != expected:
                text = f"{side} image is in frame {frame!r}, expected the optical frame {expected!r} of its camera"
                raise OpenArmError(Code.BAD_IMAGE, text)
            pair = self._pairs.add(side, stamp_to_ns(message.header.stamp), message)
            if pair is not None and len(self._infos) == 2:
                self._process(*pair)
        except OpenArmError as error:
            self._refused += 1
            self._fault = f"pair refused: {error.message}"
            self.get_logger().warning(self._fault, throttle_duration_sec=5.0)

    def _process(self, t_ns: int, left: Image, right: Image) -> None:
        started = time.perf_counter()
        matcher = self._current_matcher()
        first, second = rgb_image(left), rgb_image(right)
        depth = matcher.depth(first, second)
        frame, rectification = self._frames["left"], matcher.rectification
        pixels = depth if self.config.encoding == "32FC1" else millimetres(depth.copy())
        self._depth.publish(array_to_image(pixels, self.config.encoding, frame, t_ns))
        self._info.publish(info_from_intrinsics(rectification.intrinsics, frame, t_ns))
        if self._rectified.get_subscription_count():
            image, _ = rectification.rectify(first, second)
            self._rectified.publish(array_to_image(image, "rgb8", frame, t_ns))
        self._frames_done += 1
        self._fault = ""
        self._valid = 100.0 * _share(depth)
        self._elapsed_ms = (time.perf_counter() - started) * 1e3

    def _current_matcher(self) -> StereoMatcher:
        """Return the matcher of the present CameraInfos."""
        left, right = self._infos["left"], self._infos["right"]
        made_of = tuple(
            (info.width, info.height, info.distortion_model, *info.d, *info.k, *info.r, *info.p)
            for info in (left, right)
        )
        if self._matcher is None or made_of != self._made_of:
            if self._T_left_right is not None:
                lenses = lens_from_info(left), lens_from_info(right)
                rectification = Rectification.from_pose(*lenses, self._T_left_right)
            else:
                ready = self.config.rectified or is_rectified(self.config.left_topic)
                rectification = Rectification(_rectified(left, ready), _rectified(right, ready))
            self._matcher, self._made_of = StereoMatcher(self.config.matcher, rectification, self._limits), made_of
        return self._matcher


def _pair(config: StereoNodeConfig) -> tuple[CameraConfig, CameraConfig]:
    """Return both cameras of the pair.

    Raises:
        OpenArmError: CONFIG_INVALID, listing the pairs there are.
    """
    pairs = stereo_pairs()
    if config.camera not in pairs:
        there = ", ".join(pairs) or "none; a right camera of cameras.yaml names its `left`"
        raise OpenArmError(
            Code.CONFIG_INVALID, f"camera {config.camera!r} is not the left one of a pair; left cameras: {there}"
        )
    return depth_camera(config.camera), load_cameras()[pairs[config.camera]]


def _rectified(info: CameraInfo, ready: bool) -> Rectified:
    """Read how a camera is rectified; `ready`: its images are already.

    Raises:
        OpenArmError: BAD_IMAGE, as `lens_from_info` and `rotation_from_info`.
    """
    lens = lens_from_info(info, rectified=ready)
    return Rectified(lens, np.eye(3) if ready else rotation_from_info(info), projection_from_info(info))


def _share(depth: Floats) -> float:
    return float(np.count_nonzero(depth > 0.0)) / depth.size


def main() -> None:
    """Run the node."""
    cv2.setNumThreads(1)  # the cores belong to the control of the arms
    run(StereoNode)


if __name__ == "__main__":
    main()
