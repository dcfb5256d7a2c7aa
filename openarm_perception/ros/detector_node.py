# SPDX-License-Identifier: Apache-2.0
"""Node `detector`: colour and depth images to objects in the image and in the base frame.

The camera, and /joint_states for the robot in view, are subscribed to only while an output of the node is.
"""

from __future__ import annotations

import time
from collections import Counter, deque
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from openarm_interfaces.srv import MeasureTable
from sensor_msgs.msg import CameraInfo, Image, PointCloud2
from vision_msgs.msg import Detection2DArray, Detection3DArray
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.cameras import Intrinsics, depth_camera
from openarm_common.camera.depth_view import DepthImage, DepthView
from openarm_common.camera.stream import Frame
from openarm_common.config import load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_common.robot.posture import JointNeed, Posture
from openarm_common.ros.answers import answering
from openarm_common.ros.camera_stream import CameraStream, camera_topics
from openarm_common.ros.detections import detections_to_msg
from openarm_common.ros.images import array_to_image, color_of, depth_of, is_rectified, lens_from_info
from openarm_common.ros.labelled_clouds import labelled_cloud_to_msg
from openarm_common.ros.node import QOS_LATCHED, QOS_SENSOR, BaseNode, reliable, run
from openarm_common.ros.tf import RobotStateListener
from openarm_perception.config import DetectNodeConfig
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Mask
from openarm_perception.detection.draw import annotate
from openarm_perception.detection.follow import followed
from openarm_perception.detection.localize import Localizer
from openarm_perception.detection.network import NetworkConfig, NetworkDetector
from openarm_perception.detection.pipeline import Perceived, Pipeline, make_pipeline
from openarm_perception.detection.robot import RobotFinder
from openarm_perception.geometry.depth import DepthLimits, View
from openarm_perception.geometry.watch import CameraWatch
from openarm_perception.ros import convert
from openarm_world.carried import carriers
from openarm_world.objects import Objects

#: A measurement is made of an image that is not older than this, s.
_FRESH = 1.0
#: A stream that is silent for so long while others come is reported, s.
_PATIENCE = 2.0
#: What /diagnostics counts.
_COUNTS = ("frames", "skipped", "uncut", "refused_frames", "refused_objects", "withheld")


class DetectNode(BaseNode[DetectNodeConfig]):
    """Detects objects on demand."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("detector", DetectNodeConfig, **kwargs)
        config = self.config
        camera = depth_camera(config.camera)
        self._optical_frame = camera.optical_frame
        colors = Path(config.colors) if config.colors else config_dir() / "params" / "detector.yaml"
        limits = DepthLimits(near=camera.near, far=camera.far)
        self._colors = ColorDetector(load_config(colors, ColorDetectorConfig))
        self._localizer = Localizer(config.localizer, limits, config.table_top_z())
        self._watch = CameraWatch(config.watch, limits, camera.intrinsics)
        self._pipeline = self._make(config, NetworkConfig())
        self.accept_changes(self._take)
        #: Without depth it is unknown which pixels are the robot.
        cuts = config.self_filter.enabled and bool(config.depth_topic)
        self._robot = RobotFinder(self.description, config.self_filter) if cuts else None
        #: Pixels of the robot in the last image, by link or `held/NAME`; or why it was not found.
        self._removed: dict[str, int] = {}
        self._uncut = ""
        # Without joint states a fixed camera still detects objects, and takes the robot for one of them.
        rides = any(joint.type != "fixed" for joint in self.description.chain(camera.parent))
        need: JointNeed = "required" if rides else "optional" if cuts else "none"
        states = RobotStateListener(
            self, self.description, joints=False, depth=100, wait=config.transform_wait,
            held_topic=config.held_topic if cuts else "",
        )  # fmt: skip
        if self._robot is not None:
            states.follow_mounts(self._robot.mount)
        if config.table_height is None:
            states.follow_table(self._take_table)
        # without a depth topic, objects of known height are located by colour alone
        depth = {"depth": config.depth_topic} if config.depth_topic else {}
        topics = camera_topics(config.camera, color=config.color_topic, info=config.info_topic, **depth)
        self._stream = CameraStream(
            self, states, topics, camera.optical_frame, joints=need,
            max_rate=config.max_rate, on_frame=self._on_frame, on_refusal=self._refuse,
        )  # fmt: skip
        calibrated = config.calibrated_topic.format(camera=config.camera)
        self.create_subscription(CameraInfo, calibrated, self._take_calibrated, QOS_LATCHED)
        #: The newest frame whose camera pose is known, and when it came.
        self._newest: View | None = None
        self._newest_at = self._asked_until = self._listens_since = 0.0
        self._counts = Counter(dict.fromkeys(_COUNTS, 0))
        self._began: deque[float] = deque(maxlen=20)
        self._followed = Objects(config.objects)

        self._boxes = self.create_publisher(Detection2DArray, "/detections_2d", reliable(5))
        self._objects = self.create_publisher(Detection3DArray, "/detections_3d", reliable(5))
        self._picture = self.create_publisher(Image, "/detection_image", QOS_SENSOR)
        self._mask = self.create_publisher(Image, "/detection_mask", QOS_SENSOR)
        # without depth there are no points, and whoever needs some makes them of the boxes
        self._clouds = self.create_publisher(PointCloud2, "/detection_points", QOS_SENSOR) if depth else None
        self._markers = self.create_publisher(MarkerArray, "/detection_markers", reliable(5))
        self.create_timer(0.1, self._follow_demand, clock=self.steady_clock)
        self.diagnose(True, "idle: no subscribers", **self._counts)
        self.create_service(MeasureTable, "~/measure_table", answering(self._measure_table))

    def _make(self, config: DetectNodeConfig, known: NetworkConfig, before: Pipeline | None = None) -> Pipeline:
        """Make the pipeline; a network that is given is read though another detector is chosen, to refuse it now."""
        if config.network.model != known.model and config.detector not in ("network", "both"):
            NetworkDetector(config.network)
        made = make_pipeline(
            config.detector,
            self._colors,
            config.network,
            self._localizer,
            config.policy,
            config.label,
            before,
            config.tag,
        )
        made.faults = config.faults
        return made

    def _take(self, config: DetectNodeConfig) -> None:
        """Detect as configured from the next frame on."""
        self._pipeline = self._make(config, self.config.network, self._pipeline)

    @property
    def waiting_ns(self) -> int | None:
        """Stamp of the newest frame that waits for the pose of its camera."""
        return self._stream.frames.waiting_ns

    @property
    def table_height(self) -> float:
        """What the table is taken for, base frame, m."""
        return self._localizer.table_height

    @property
    def measurable(self) -> bool:
        """Whether there is an image that the table can be measured in."""
        return self._newest is not None and time.monotonic() - self._newest_at <= _FRESH

    def _take_table(self, height: float) -> None:
        self._localizer.table_height = height

    def _take_calibrated(self, info: CameraInfo) -> None:
        """Compare with these intrinsics from now on; none: those of the calibration are not known."""
        try:
            self._watch.calibrated = lens_from_info(info).intrinsics if info.width else None
        except OpenArmError as error:
            self.get_logger().warning(f"intrinsics of the calibration are ignored: {error.message}")

    def _follow_demand(self) -> None:
        self._stream.poll()
        outputs = (self._boxes, self._objects, self._picture, self._mask, self._clouds, self._markers)
        asked = time.monotonic() < self._asked_until
        wanted = asked or any(output.get_subscription_count() for output in outputs if output is not None)
        if wanted != self._stream.listening:
            self._stream.listen(wanted)
            self._listens_since = time.monotonic()
            message = f"waiting for images of {self.config.camera}" if wanted else "idle: no subscribers"
            self.diagnose(True, message, **self._counts)
        elif wanted and self._stream.frames.silent == ["depth"] and time.monotonic() > self._listens_since + _PATIENCE:
            topic = self.config.depth_topic.format(camera=self.config.camera)
            message = (
                f"colour images come, but no depth on {topic}; with a camera that has none set depth_topic to ''"
                " and localizer.heights (as `openarm up no_depth` does)"
            )
            self.diagnose(False, message, **self._counts)

    def _on_frame(self, frame: Frame[Any]) -> None:
        posture = frame.posture
        try:
            items = frame.items
            lens = lens_from_info(items["info"], rectified=is_rectified(self.config.color_topic))
            rgb, intrinsics = color_of(items["color"], lens), lens.intrinsics
            depth = np.zeros(rgb.shape[:2], np.uint16)
            if "depth" in items:
                depth = depth_of(items["depth"], lens)
            started = time.perf_counter()
            robot = self._find_robot(depth, intrinsics, posture)
            self._newest = View(rgb, depth, intrinsics, posture.T_base_frame, robot)
            self._newest_at = time.monotonic()
            withheld = self._watch.look(frame.t_ns, self._newest, self.table_height)
            perceived = self._pipeline.run(rgb, depth, intrinsics, posture.T_base_frame, robot, withheld, frame.t_ns)
            held = None if self._uncut else carriers(self.description, posture.joints, posture.held)
            if not self._followed.t_ns:
                self._followed = replace(self._followed, next_id=_first_id(frame.t_ns))
            self._followed, perceived, cloud = followed(
                self._followed, perceived, self._newest, self._localizer.limits, frame.t_ns, held
            )
        except OpenArmError as error:
            self._refuse(error)
            return
        # first, so that whoever waits for the objects has them
        if self._clouds is not None and self._clouds.get_subscription_count():
            self._clouds.publish(labelled_cloud_to_msg(cloud, self._optical_frame, frame.t_ns))
        self._publish(frame.t_ns, rgb, perceived, (time.perf_counter() - started) * 1e3)

    def _find_robot(self, depth: DepthImage, intrinsics: Intrinsics, posture: Posture) -> Mask | None:
        if self._robot is None:
            return None
        self._uncut = posture.lack
        if posture.lack:
            return None
        limits = self._localizer.limits
        try:
            view = DepthView(depth, intrinsics, posture.T_base_frame, limits.near, limits.far)
            robot, self._removed = self._robot.find(view, posture.joints, posture.held)
        except OpenArmError as error:
            self._uncut = error.message
            return None
        return robot

    def _publish(self, t_ns: int, rgb: NDArray[np.uint8], perceived: Perceived, elapsed_ms: float) -> None:
        self._boxes.publish(convert.detections_2d(perceived, self._optical_frame, t_ns))
        covariances = [located.covariance for located in perceived.boxes]
        self._objects.publish(detections_to_msg(perceived.boxes, covariances, self.description.base, t_ns))
        if self._markers.get_subscription_count():
            self._markers.publish(convert.markers(perceived.boxes, self.description.base, t_ns))
        if self._picture.get_subscription_count():
            self._picture.publish(array_to_image(annotate(rgb, perceived), "rgb8", self._optical_frame, t_ns))
        if self._mask.get_subscription_count():
            mask = convert.mask_image(perceived, rgb.shape[:2])
            self._mask.publish(array_to_image(mask, "mono8", self._optical_frame, t_ns))
        self._counts["frames"] += 1
        self._counts["refused_objects"] += len(perceived.refused)
        message = f"in view: {', '.join(found.label for found in perceived.located) or 'nothing'}"
        message += f"; not located: {'; '.join(perceived.refused)}" if perceived.refused else ""
        values: dict[str, object] = {"processing_ms": f"{elapsed_ms:.1f}", "rate_hz": self._rate(), **self._counts}
        values |= self._stream.frames.given_up()
        values["detector"] = self.config.detector
        if self._uncut:
            self._counts["uncut"] += 1
            message += f"; the robot is taken for an object: {self._uncut}"
        else:
            values |= {f"removed/{name}": n for name, n in self._removed.items()}
        if perceived.withheld is not None:
            self._counts["withheld"] += 1
            message = f"no object is a target: {perceived.withheld}; {message}"
            self.get_logger().error(str(perceived.withheld), throttle_duration_sec=5.0)
        alarm = self._watch.alarm
        values["code"] = Code.OK if alarm is None else alarm.code
        self.diagnose(alarm is None, message, **values)

    def _rate(self) -> str:
        """Return the frames a second of the wall clock, over the last twenty."""
        self._began.append(time.monotonic())
        span = self._began[-1] - self._began[0]
        return f"{(len(self._began) - 1) / span:.1f}" if span > 0.0 else "0"

    def _measure_table(self, request: MeasureTable.Request, response: MeasureTable.Response) -> str:
        self._asked_until = time.monotonic() + 5.0
        if self._newest is None or not self.measurable:
            camera = self.config.camera
            raise OpenArmError(
                Code.NOT_READY, f"no image of {camera} yet; it is subscribed to now: ask again in a second"
            )
        table = self._pipeline.measure_table(self._newest, request.block_height, request.label)
        response.height, response.std, response.tilt = table.height, table.std, table.tilt
        response.points = table.points
        return f"the table is {table.height:.4f} m high; the detector takes it for {self.table_height:.4f} m"

    def _refuse(self, error: OpenArmError) -> None:
        late = error.code in (Code.STALE_DATA, Code.NO_TRANSFORM)
        self._counts["skipped" if late else "refused_frames"] += 1
        message = f"frame {'skipped: pose of the camera at its stamp' if late else 'refused'}: {error.message}"
        self.get_logger().warning(message, throttle_duration_sec=5.0)
        self.diagnose(False, message, **self._counts)


def _first_id(t_ns: int) -> int:
    """Return the tenths of a second of the day: a detector that has started again gives no id of before."""
    return 1 + t_ns // 100_000_000 % 864_000


def main() -> None:
    """Run the node."""
    run(DetectNode)


if __name__ == "__main__":
    main()
