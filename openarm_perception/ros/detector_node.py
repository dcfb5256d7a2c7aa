# SPDX-License-Identifier: Apache-2.0
"""Node `detector`: colour and depth images to objects in the image and in the base frame.

It listens to the camera, and to /joint_states for the robot in view, only while somebody listens to it.
"""

from __future__ import annotations

import time
from collections import deque
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray
from openarm_interfaces.srv import MeasureTable
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, Image
from vision_msgs.msg import Detection2DArray, Detection3DArray
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.depth_view import DepthView
from openarm_common.config import load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_common.ros.convert import array_to_image, image_to_array, intrinsics_from_info, stamp_to_ns
from openarm_common.ros.node import BASE_FRAME, QOS_NEWEST, QOS_SENSOR, BaseNode, reliable, run
from openarm_common.ros.tf import Posture, RobotStateListener
from openarm_perception.config import DetectNodeConfig, camera_of
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Mask
from openarm_perception.detection.draw import annotate
from openarm_perception.detection.localize import Localizer
from openarm_perception.detection.looking import make_pipeline
from openarm_perception.detection.matching import StampMatcher
from openarm_perception.detection.pipeline import Perceived, Pipeline
from openarm_perception.geometry.depth import DepthImage, DepthLimits
from openarm_perception.ros import convert
from openarm_perception.ros.robot_listener import RobotInView
from openarm_perception.ros.table_server import Frame, Placed, answer

#: A measurement is made of an image that is not older than this, s.
_FRESH = 1.0


class DetectNode(BaseNode[DetectNodeConfig]):
    """Detects objects while asked to."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("detector", DetectNodeConfig, **kwargs)
        config = self.config
        camera = camera_of(config.camera)
        self._optical_frame = camera.optical_frame
        #: Whether the camera rides on an arm, so that its pose needs joint states.
        self._rides = any(joint.type != "fixed" for joint in self.description.chain(camera.parent))
        colors = Path(config.colors) if config.colors else config_dir() / "params" / "detector.yaml"
        #: Why objects are found by colour though something else was asked for.
        self._fallback = ""
        limits = DepthLimits(near=camera.near, far=camera.far)
        self._colors = ColorDetector(load_config(colors, ColorDetectorConfig))
        self._localizer = Localizer(config.localizer, limits, config.table_top_z())
        self._pipeline = self._first_pipeline()
        self.accept_changes(self._take)
        self._poses = RobotStateListener(
            self, self.description, joints=False, depth=100, wait=config.transform_wait, on_news=self._try_waiting
        )
        self._matcher: StampMatcher[Image | CameraInfo] = StampMatcher(tuple(self._topics()), self._on_frame)
        self._inputs: list[Subscription] = []
        self._waiting: Frame | None = None
        #: The newest frame whose camera pose is known.
        self._newest: Placed | None = None
        #: Without depth nothing says which pixels are the robot.
        self._robot: RobotInView | None = None
        if config.self_filter.enabled and config.depth_topic:
            self._robot = RobotInView(self, config.self_filter, config.held_topic)
        #: Why the robot could not be told from objects in the last frame.
        self._uncut = ""
        self._listening_since = 0.0
        self._asked_until = 0.0
        self._last_ns: int | None = None
        self._counts: dict[str, int] = dict.fromkeys(
            ("frames", "skipped", "uncut", "refused_frames", "refused_objects"), 0
        )

        self._boxes = self.create_publisher(Detection2DArray, "/detections_2d", reliable(5))
        self._objects = self.create_publisher(Detection3DArray, "/detections_3d", reliable(5))
        self._picture = self.create_publisher(Image, "/detection_image", QOS_SENSOR)
        self._mask = self.create_publisher(Image, "/detection_mask", QOS_SENSOR)
        self._markers = self.create_publisher(MarkerArray, "/detection_markers", reliable(5))
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)
        self.diagnose(True, "idle: nobody listens", **self._counts)
        self.create_service(MeasureTable, "~/measure_table", self._on_measure_table)
        self._began: deque[float] = deque(maxlen=20)

    def _make(self, config: DetectNodeConfig, before: Pipeline | None = None) -> Pipeline:
        return make_pipeline(
            config.detector, self._colors, config.network, self._localizer, config.policy, config.label, before
        )

    def _first_pipeline(self) -> Pipeline:
        """As configured; a network that cannot be used leaves the work to the colour detector."""
        try:
            return self._make(self.config)
        except OpenArmError as error:
            self._fallback = f"; by colour instead of {self.config.detector}: {error.message}"
            self.get_logger().error(f"{error.message}; objects are found by colour")
            return self._make(self.config.model_copy(update={"detector": "color"}))

    def _take(self, config: DetectNodeConfig) -> None:
        """Detect as configured from the next frame on."""
        if (config.detector, config.network) == (self.config.detector, self.config.network):
            # holds too while colours stand in for a network that cannot be used
            self._pipeline.policy, self._pipeline.label = config.policy, config.label
            return
        self._pipeline = self._make(config, self._pipeline)
        self._fallback = ""

    @property
    def waiting_ns(self) -> int | None:
        """Stamp of the frame that waits for the pose of its camera."""
        return self._waiting.t_ns if self._waiting else None

    @property
    def measurable(self) -> bool:
        """Whether there is an image that the table can be measured in."""
        return self._newest is not None and time.monotonic() - self._newest.at <= _FRESH

    def _follow_demand(self) -> None:
        self._try_waiting()  # what is waited for may never come
        outputs = (self._boxes, self._objects, self._picture, self._mask, self._markers)
        asked = time.monotonic() < self._asked_until
        wanted = asked or any(output.get_subscription_count() for output in outputs)
        if wanted and not self._inputs:
            self._subscribe()
        elif not wanted and self._inputs:
            for subscription in self._inputs:
                self.destroy_subscription(subscription)
            self._inputs.clear()
            self._matcher.clear()
            self._waiting, self._last_ns = None, None
            self._poses.enable(False)
            self.diagnose(True, "idle: nobody listens", **self._counts)

    def _topics(self) -> dict[str, tuple[type[Image | CameraInfo], str]]:
        """Streams that make a frame: without a depth topic, objects of known height are located by colour alone."""
        config = self.config
        topics: dict[str, tuple[type[Image | CameraInfo], str]] = {
            "color": (Image, config.color_topic),
            "info": (CameraInfo, config.info_topic),
        }
        return topics | ({"depth": (Image, config.depth_topic)} if config.depth_topic else {})

    def _subscribe(self) -> None:
        self._poses.enable(self._rides or self._robot is not None)
        self._listening_since = time.monotonic()
        for stream, (kind, topic) in self._topics().items():

            def add(message: Image | CameraInfo, stream: str = stream) -> None:
                self._matcher.add(stream, stamp_to_ns(message.header.stamp), message)

            name = topic.format(camera=self.config.camera)
            self._inputs.append(self.create_subscription(kind, name, add, QOS_NEWEST))
        self.diagnose(True, f"waiting for images of {self.config.camera}", **self._counts)

    def _on_frame(self, t_ns: int, messages: dict[str, Image | CameraInfo]) -> None:
        last = self._last_ns
        # a stamp before the last one is a restarted simulation, not a frame that came too early
        if self._waiting or (last is not None and 0 <= t_ns - last < 0.999e9 / self.config.max_rate):
            return
        self._last_ns = t_ns
        try:
            self._waiting = self._check(t_ns, messages)
        except OpenArmError as error:
            self._complain("refused_frames", f"frame refused: {error.message}")
            return
        self._try_waiting()

    def _check(self, t_ns: int, messages: dict[str, Image | CameraInfo]) -> Frame:
        color, info = cast(Image, messages["color"]), cast(CameraInfo, messages["info"])
        convert.check_frames(messages, self._optical_frame)
        rgb = image_to_array(color)
        if color.encoding not in ("rgb8", "bgr8"):
            raise OpenArmError(Code.BAD_IMAGE, f"colour image is {color.encoding!r}; valid: rgb8, bgr8")
        if color.encoding == "bgr8":
            rgb = np.ascontiguousarray(rgb[..., ::-1])
        return Frame(
            t_ns,
            cast(NDArray[np.uint8], rgb),
            cast(DepthImage, image_to_array(cast(Image, messages["depth"])))
            if "depth" in messages
            else np.zeros(rgb.shape[:2], np.uint16),
            intrinsics_from_info(info),
            time.monotonic(),
        )

    def _try_waiting(self) -> None:
        frame = self._waiting
        if frame is None:
            return
        try:
            posture = self._posture(frame)
        except OpenArmError as error:
            self._waiting = None
            if error.code is Code.STALE_DATA and self._starting():
                self._counts["skipped"] += 1
                return
            self._complain("skipped", f"frame skipped: pose of the camera at its stamp: {error.message}")
            return
        if posture is None:
            return
        self._waiting = None
        try:
            started = time.perf_counter()
            robot = self._find_robot(frame, posture)
            self._newest = Placed(frame, posture.T_base_frame, robot, time.monotonic())
            perceived = self._pipeline.run(frame.rgb, frame.depth, frame.intrinsics, posture.T_base_frame, robot)
        except OpenArmError as error:
            self._complain("refused_frames", f"frame refused: {error.message}")
            return
        self._publish(frame, perceived, (time.perf_counter() - started) * 1e3)

    def _posture(self, frame: Frame) -> Posture | None:
        """Camera and robot at the stamp, None while they may still come.

        Where nobody tells the joints, objects are seen still: without them, if the camera stands.
        """
        at = partial(self._poses.posture, self._optical_frame, frame.t_ns, frame.since)
        try:
            return at(joints=self._robot is not None)
        except OpenArmError as error:
            if self._rides or error.code is not Code.STALE_DATA or self._starting():
                raise
            self._uncut = error.message
            return at(joints=False)

    def _starting(self) -> bool:
        """Whether the first joint states may still be on their way."""
        return time.monotonic() < self._listening_since + self.config.transform_wait

    def _find_robot(self, frame: Frame, posture: Posture) -> Mask | None:
        if self._robot is None or not posture.joints:
            return None
        limits = self._pipeline.localizer.limits
        view = DepthView(frame.depth, frame.intrinsics, posture.T_base_frame, limits.near, limits.far)
        try:
            robot = self._robot.find(view, posture.joints)
        except OpenArmError as error:
            self._uncut = error.message
            return None
        self._uncut = ""
        return robot

    def _publish(self, frame: Frame, perceived: Perceived, elapsed_ms: float) -> None:
        self._boxes.publish(convert.detections_2d(perceived.found, self._optical_frame, frame.t_ns))
        self._objects.publish(convert.detections_3d(perceived.boxes, BASE_FRAME, frame.t_ns))
        if self._markers.get_subscription_count():
            self._markers.publish(convert.markers(perceived.boxes, BASE_FRAME, frame.t_ns))
        if self._picture.get_subscription_count():
            picture = annotate(frame.rgb, perceived)
            self._picture.publish(array_to_image(picture, "rgb8", self._optical_frame, frame.t_ns))
        if self._mask.get_subscription_count():
            mask = convert.mask_image(perceived, frame.rgb.shape[:2])
            self._mask.publish(array_to_image(mask, "mono8", self._optical_frame, frame.t_ns))
        self._counts["frames"] += 1
        self._counts["refused_objects"] += len(perceived.refused)
        view = ", ".join(detection.label for detection in perceived.located) or "nothing"
        refused = f"; not located: {'; '.join(perceived.refused)}" if perceived.refused else ""
        values: dict[str, object] = {"processing_ms": f"{elapsed_ms:.1f}", "rate_hz": self._rate(), **self._counts}
        values["detector"] = "color" if self._fallback else self.config.detector
        if self._robot is not None and perceived.robot is None:
            self._counts["uncut"] += 1
            refused += f"; the robot is taken for surroundings: {self._uncut}"
        elif self._robot is not None:
            values |= self._robot.values()
        self.diagnose(not self._fallback, f"in view: {view}{refused}{self._fallback}", **values)

    def _rate(self) -> str:
        """Frames a second of the wall clock, over the last twenty."""
        self._began.append(time.monotonic())
        span = self._began[-1] - self._began[0]
        return f"{(len(self._began) - 1) / span:.1f}" if span > 0.0 else "0"

    def _on_measure_table(
        self, request: MeasureTable.Request, response: MeasureTable.Response
    ) -> MeasureTable.Response:
        self._asked_until = time.monotonic() + 5.0
        return answer(request, response, self._newest if self.measurable else None, self._pipeline, self.config.camera)

    def _complain(self, count: str, message: str) -> None:
        self._counts[count] += 1
        self.get_logger().warning(message, throttle_duration_sec=5.0)
        self.diagnose(False, message, **self._counts)


def main() -> None:
    """Run the node."""
    run(DetectNode)


if __name__ == "__main__":
    main()
