# SPDX-License-Identifier: Apache-2.0
"""A camera made of rectangles (flat images, exact depth), a detector that sees through it, and what is heard of it."""

from __future__ import annotations

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image, JointState
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray

from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform, stamp_to_ns
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR, reliable
from openarm_perception.ros.detector_node import DetectNode

BASE_FRAME = RobotDescription.load().base

TABLE, TOP = 0.40, 0.45
MS = 1_000_000


class FakeCamera:
    """Publishes what a camera straight above the table sees of one red box, and the fixed edges of its mount.

    The camera `name` hangs 0.5 m above the box, image up = base x. The box is 6 cm along x, 4 cm along y and 5 cm high.
    """

    def __init__(self, ros, name: str = "overhead", parent: str = BASE_FRAME, T_base_parent=None) -> None:
        self.node = ros.node
        self.config = load_cameras()[name]
        self.frame = self.config.optical_frame
        self.K = self.config.intrinsics
        self.pubs = {
            "color": self.node.create_publisher(Image, f"/{name}/color/image_raw", QOS_SENSOR),
            "depth": self.node.create_publisher(Image, f"/{name}/depth/image_raw", QOS_SENSOR),
            "info": self.node.create_publisher(CameraInfo, f"/{name}/depth/camera_info", QOS_SENSOR),
        }
        self.static = self.node.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self.joints = self.node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        R = se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
        self.T_base_optical = se3.make(R, (0.30, -0.20, TOP + 0.5))
        T_parent_optical = se3.inverse(np.eye(4) if T_base_parent is None else T_base_parent) @ self.T_base_optical
        self.mount = TFMessage(
            transforms=[
                matrix_to_transform(parent, f"{name}_link", T_parent_optical @ se3.inverse(T_LINK_OPTICAL), 0),
                matrix_to_transform(f"{name}_link", self.frame, T_LINK_OPTICAL, 0),
            ]
        )
        depth = np.full((480, 640), 0.55, np.float32)
        rgb = np.full((480, 640, 3), (180, 176, 170), np.uint8)
        across, along = (round(edge * self.K.fx / 0.5 / 2.0) for edge in (0.04, 0.06))
        self.patch = (slice(240 - along, 240 + along), slice(320 - across, 320 + across))
        depth[self.patch], rgb[self.patch] = 0.5, (205, 25, 25)
        self.rgb, self.depth = rgb, depth

    def publish_mount(self) -> None:
        self.static.publish(self.mount)

    def publish(self, t_ns: int, **replace) -> None:
        """One frame; `replace` gives other messages for a stream."""
        messages = {
            "color": array_to_image(self.rgb, "rgb8", self.frame, t_ns),
            "depth": array_to_image(np.round(self.depth * 1e3).astype(np.uint16), "16UC1", self.frame, t_ns),
            "info": info_from_intrinsics(self.K, self.frame, t_ns),
        }
        for stream, message in (messages | replace).items():
            if stream in self.pubs:
                self.pubs[stream].publish(message)

    def watched(self) -> bool:
        return all(pub.get_subscription_count() for pub in self.pubs.values())

    def unwatched(self) -> bool:
        return not any(pub.get_subscription_count() for pub in self.pubs.values())


class Watch:
    """Collects what a topic says."""

    def __init__(self, ros, kind, topic: str, qos=None) -> None:
        self.got: list = []
        self.subscription = ros.node.create_subscription(kind, topic, self.got.append, qos or reliable(10))


class Bench:
    """A camera, a detector and a watcher of /detections_3d."""

    def __init__(self, ros, *, camera: FakeCamera, mounted: bool = True, **params) -> None:
        self.ros, self.camera = ros, camera
        if mounted:
            camera.publish_mount()
        # no joint states come for a camera that is fixed, and its frames do not wait for them
        values = {"camera": camera.config.name, "transform_wait": 0.02, **params}
        self.node = ros.start(DetectNode, **values)
        self.watch = Watch(ros, Detection3DArray, "/detections_3d")
        self.diagnostics = Watch(ros, DiagnosticArray, "/diagnostics")
        self.t_ns = 1_000 * MS
        ros.spin_until(camera.watched, what="the detector listens to the camera")

    def frame(self, **replace) -> None:
        self.t_ns += 200 * MS
        self.camera.publish(self.t_ns, **replace)

    def pump(self, condition, what: str, **make) -> None:
        """Publish a frame, and another every tenth of a second (best effort may lose one), until `condition` holds.

        `make` gives functions of the stamp that replace the message of a stream.
        """

        def send() -> None:
            t_ns = self.t_ns + 200 * MS
            self.frame(**{stream: message(t_ns) for stream, message in make.items()})

        self.ros.send_until(send, 0.1, condition, what)

    def detect(self, what: str = "a detection") -> Detection3DArray:
        """The answer to a frame that is newer than every one before."""
        before = self.t_ns
        self.pump(lambda: bool(self.watch.got) and stamp_to_ns(self.watch.got[-1].header.stamp) > before, what)
        return self.watch.got[-1]

    def said(self, text: str, **make) -> None:
        """Publish frames until the diagnostics say `text`."""

        def heard() -> bool:
            statuses = [s for m in self.diagnostics.got for s in m.status if s.name.startswith("detector")]
            return any(text in s.message for s in statuses)

        self.pump(heard, f"diagnostics with {text!r}", **make)
