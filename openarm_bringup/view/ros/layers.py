# SPDX-License-Identifier: Apache-2.0
"""Layers of a page: each is a class that subscribes while it exists.

Subscriptions are polled and keep the newest message alone: of a topic with 100 Hz, no more is taken, and no more of it
deserialised, than is shown.
"""

from __future__ import annotations

import json
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from octomap_msgs.msg import Octomap
from openarm_interfaces.msg import GraspStatus
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image, JointState
from std_msgs.msg import Float64
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection3DArray
from visualization_msgs.msg import Marker, MarkerArray

from openarm_bringup.view import wire
from openarm_common.camera.cameras import CameraConfig
from openarm_common.octree.codec import decode
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.convert import (
    held_from_msg,
    image_to_array,
    intrinsics_from_info,
    pose_to_matrix,
    stamp_to_ns,
    transform_to_matrix,
    xyz,
)
from openarm_common.ros.node import BASE_FRAME, QOS_LATCHED, QOS_NEWEST, QOS_STATIC_TF
from openarm_perception.geometry.depth import Deprojector, DepthLimits

#: A key (the newest payload of each is kept for a page) and what goes to the page.
Items = Iterator[tuple[str, str | bytes]]
#: A node that was silent for so long is shown so, s.
_SILENT_S = 4.0


class Polled:
    """A subscription that is polled; its node is not spun.

    Args:
        node: Owns it.
        kind: Type of the messages.
        topic: Absolute name.
        qos: Quality of service.
    """

    def __init__(self, node: Node, kind: Any, topic: str, qos: QoSProfile = QOS_NEWEST) -> None:
        self.topic = topic
        self._node = node
        self._subscription: Any = node.create_subscription(kind, topic, _unused, qos)
        self.received_at = time.monotonic()

    def take(self) -> list[Any]:
        """All messages that wait."""
        taken: list[Any] = []
        handle, kind = self._subscription.handle, self._subscription.msg_type
        with handle:
            while (one := handle.take_message(kind, False)) is not None:
                taken.append(one[0])
        if taken:
            self.received_at = time.monotonic()
        return taken

    def newest(self) -> Any | None:
        """The newest message that waits, or None when nothing has come."""
        taken = self.take()
        return taken[-1] if taken else None

    def silence(self, limit: float) -> str:
        """What to say when nothing has come for longer than a limit, s; else nothing."""
        silent = time.monotonic() - self.received_at
        return f"nothing on {self.topic} for {silent:.0f} s" if silent > limit else ""

    def close(self) -> None:
        """Unsubscribe."""
        self._node.destroy_subscription(self._subscription)


class Layer(ABC):
    """One layer.

    Attributes:
        period: Between two updates, s.
        fault: What keeps it from being shown; empty when nothing does.
    """

    period = 0.2

    def __init__(self, node: Node) -> None:
        self.fault = ""
        self._node = node
        self._polled: list[Polled] = []

    @abstractmethod
    def update(self) -> Items:
        """Yield what is new since the last update."""

    def close(self) -> None:
        """Unsubscribe."""
        for polled in self._polled:
            polled.close()

    def _subscribe(self, kind: Any, topic: str, qos: QoSProfile = QOS_NEWEST) -> Polled:
        self._polled.append(Polled(self._node, kind, topic, qos))
        return self._polled[-1]


class StatesLayer(Layer):
    """States of the grasp, diagnostics, speed of the simulation."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._status = self._subscribe(
            GraspStatus, "/grasp/status", QoSProfile(depth=20, durability=QOS_LATCHED.durability)
        )
        self._diagnostics = self._subscribe(DiagnosticArray, "/diagnostics", QoSProfile(depth=100))
        self._speed = self._subscribe(Float64, "/sim/real_time_factor")
        self._steps: deque[dict[str, Any]] = deque(maxlen=40)
        self._nodes: dict[str, tuple[float, DiagnosticStatus]] = {}
        self._told = 0.0

    def update(self) -> Items:
        """Each transition of the grasp, in order; the rest once a second."""
        new = self._status.take()
        self._steps.extend(_step(message) for message in new)
        if new:
            yield "grasp", _text("grasp", steps=list(self._steps))
        now = time.monotonic()
        for message in self._diagnostics.take():
            self._nodes.update({status.name: (now, status) for status in message.status})
        if now - self._told > 1.0:
            self._told = now
            speed = self._speed.newest()
            nodes = [_health(status, now - at) for at, status in self._nodes.values()]
            yield (
                "health",
                _text("health", nodes=sorted(nodes, key=_by_name), speed=None if speed is None else speed.data),
            )


class RobotLayer(Layer):
    """Where the links are, and what hangs on them."""

    period = 0.04

    def __init__(self, node: Node, description: RobotDescription) -> None:
        super().__init__(node)
        self._description = description
        self._joints = self._subscribe(JointState, "/joint_states")
        self._held = self._subscribe(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self._shown: list[float] = []

    def update(self) -> Items:
        """Poses of the links when they have changed; held objects when they have."""
        joints = self._joints.newest()
        self.fault = self._joints.silence(1.0)
        if joints is not None and not (self._shown and np.allclose(joints.position, self._shown, atol=2e-5)):
            self._shown = list(joints.position)
            q = dict(zip(joints.name, joints.position, strict=True))
            yield "robot", wire.frame({"kind": "robot"}, wire.link_poses(self._description, q))
        held = self._held.newest()
        if held is not None:
            boxes = [wire.box(b.name, b.T_link_box, b.size, link=b.link) for b in held_from_msg(held)]
            yield "held", _text("held", boxes=boxes)


class ImageLayer(Layer):
    """The picture of a camera, up to five times a second."""

    def __init__(self, node: Node, camera: str) -> None:
        super().__init__(node)
        self._camera = camera
        self._image = self._subscribe(Image, f"/{camera}/color/image_raw")

    def update(self) -> Items:
        """The newest picture as JPEG."""
        image = self._image.newest()
        self.fault = self._image.silence(3.0)
        if image is not None:
            key = f"image:{self._camera}"
            yield key, wire.frame({"kind": "image", "camera": self._camera}, wire.jpeg(_rgb(image)))


class CloudLayer(Layer):
    """Points of a fixed camera with their colours, one a centimetre."""

    period = 0.25

    def __init__(self, node: Node, description: RobotDescription, camera: CameraConfig) -> None:
        super().__init__(node)
        self._frame = camera.optical_frame
        self._depth = self._subscribe(Image, f"/{camera.name}/depth/image_raw")
        self._color = self._subscribe(Image, f"/{camera.name}/color/image_raw")
        self._info = self._subscribe(CameraInfo, f"/{camera.name}/depth/camera_info")
        self._static = self._subscribe(TFMessage, "/tf_static", QOS_STATIC_TF)
        self._states = RobotStateBuffer(description)
        self._maker = wire.CloudMaker(Deprojector(DepthLimits(near=camera.near, far=camera.far)))
        self._images: dict[Polled, Any] = {}

    def update(self) -> Items:
        """Yield the cloud of the newest frame with both depth and colour."""
        for message in self._static.take():
            for edge in message.transforms:
                T = transform_to_matrix(edge.transform)
                self._states.set_static(edge.header.frame_id, edge.child_frame_id, T)
        for polled in (self._depth, self._color, self._info):
            self._images[polled] = polled.newest() or self._images.get(polled)
        self.fault = self._depth.silence(3.0) or self._color.silence(3.0)
        depth, color, info = (self._images[polled] for polled in (self._depth, self._color, self._info))
        if depth is None or color is None or info is None or depth.header.stamp != color.header.stamp:
            return  # the other half of the frame comes soon
        T_base_optical = self._states.lookup(BASE_FRAME, self._frame, stamp_to_ns(depth.header.stamp))
        points, colors = self._maker.make(
            image_to_array(depth), _rgb(color), intrinsics_from_info(info), T_base_optical
        )
        self._images[self._depth] = None  # shown
        yield "cloud", wire.frame({"kind": "cloud", "count": len(points)}, points, colors)


class MapLayer(Layer):
    """Occupied cells of the map."""

    period = 0.5

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._map = self._subscribe(Octomap, "/octomap_binary", QOS_LATCHED)

    def update(self) -> Items:
        """Cells of the newest map."""
        message = self._map.newest()
        self.fault = self._map.silence(5.0)
        if message is not None:
            leaves = decode(np.frombuffer(message.data, np.uint8), message.resolution, binary=message.binary)
            cells = wire.occupied_cells(leaves)
            yield "map", wire.frame({"kind": "map", "count": len(cells)}, cells)


class DetectionsLayer(Layer):
    """Objects as they are detected now."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._detections = self._subscribe(Detection3DArray, "/detections_3d")

    def update(self) -> Items:
        """The newest detections."""
        message = self._detections.newest()
        self.fault = self._detections.silence(3.0)
        if message is not None:
            yield "detections", _text("detections", boxes=[_detection_box(d) for d in message.detections if d.results])


class PlanLayer(Layer):
    """Paths of the tools on the newest plan."""

    def __init__(self, node: Node) -> None:
        super().__init__(node)
        self._preview = self._subscribe(MarkerArray, "/motion/preview", QOS_LATCHED)

    def update(self) -> Items:
        """The lines of the newest plan."""
        message = self._preview.newest()
        if message is not None:
            lines = [marker for marker in message.markers if marker.type == Marker.LINE_STRIP]
            paths = [np.round([xyz(p) for p in line.points], 4).tolist() for line in lines if line.points]
            yield "plan", _text("plan", ways=paths)


def makers(
    description: RobotDescription, cameras: Sequence[CameraConfig], cloud: str
) -> dict[str, Callable[[Node], Layer]]:
    """How to make each layer, by its name; `image:NAME` for each camera.

    Args:
        description: The robot.
        cameras: All that there are.
        cloud: Name of the camera whose cloud is shown.
    """
    (eye,) = (camera for camera in cameras if camera.name == cloud)
    fixed: dict[str, Callable[[Node], Layer]] = {
        "states": StatesLayer,
        "robot": lambda node: RobotLayer(node, description),
        "detections": DetectionsLayer,
        "plan": PlanLayer,
        "map": MapLayer,
        "cloud": lambda node: CloudLayer(node, description, eye),
    }
    images = {f"image:{c.name}": (lambda node, name=c.name: ImageLayer(node, name)) for c in cameras}
    return fixed | images


def _unused(_: object) -> None:
    """Never called: messages are polled."""


def _text(kind: str, **values: Any) -> str:
    return json.dumps({"kind": kind, **values})


def _rgb(message: Image) -> Any:
    pixels = image_to_array(message)
    return pixels[..., ::-1] if message.encoding == "bgr8" else pixels


def _step(message: GraspStatus) -> dict[str, Any]:
    names = ("state", "previous_state", "reason", "attempt", "label", "arm")
    return {"t": stamp_to_ns(message.header.stamp) * 1e-9, **{name: getattr(message, name) for name in names}}


def _health(status: DiagnosticStatus, age: float) -> dict[str, Any]:
    level = int.from_bytes(status.level, "little") if isinstance(status.level, bytes) else int(status.level)
    words = ("ok", "warning", "error", "stale")
    return {
        "name": status.name.removesuffix(": status"),
        "level": "silent" if age > _SILENT_S else words[min(level, 3)],
        "message": f"silent for {age:.0f} s" if age > _SILENT_S else status.message,
        "values": {value.key: value.value for value in status.values[:24]},
    }


def _by_name(node: dict[str, Any]) -> str:
    return node["name"]


def _detection_box(detection: Any) -> dict[str, Any]:
    best = detection.results[0].hypothesis
    size = detection.bbox.size
    pose = pose_to_matrix(detection.bbox.center)
    return wire.box(best.class_id, pose, (size.x, size.y, size.z), score=round(best.score, 3))
