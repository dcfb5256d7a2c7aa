# SPDX-License-Identifier: Apache-2.0
"""Layers of a page: each subscribes while it exists.

Subscriptions are polled and keep the newest message alone: of a topic with 100 Hz, no more is taken, and no more of it
deserialised, than is shown.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from operator import itemgetter
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
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.codec import decode
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.convert import (
    held_from_msg,
    joints_from_msg,
    pose_to_matrix,
    stamp_to_ns,
    transform_to_matrix,
    xyz,
)
from openarm_common.ros.images import color_of, depth_of, lens_from_info, rgb_image
from openarm_common.ros.node import QOS_LATCHED, QOS_STATIC_TF
from openarm_common.ros.polled import Polled, Source
from openarm_perception.geometry.depth import Deprojector, DepthLimits

#: A key (the newest payload of each is kept for a page) and what goes to the page.
Items = Iterator[tuple[str, str | bytes]]
#: A node that was silent for so long is shown so, s.
_SILENT_S = 4.0


#: Given the messages that have come from each source since the last time, yields what is new.
Show = Callable[..., Items]


class Layer:
    """One layer.

    Args:
        node: Owns the subscriptions.
        sources: Sources that are polled.
        show: Given the new messages of each of them.
        period: Between two updates, s.

    Attributes:
        fault: Reason why it is not shown; empty when it is.
        due: When it is updated next, s of the monotonic clock.
    """

    def __init__(self, node: Node, sources: Sequence[Source], show: Show, period: float = 0.2) -> None:
        self.fault = ""
        self.period = period
        self.due = 0.0
        self._show = show
        self._polled = [Polled(node, source) for source in sources]

    def update(self) -> Items:
        """Yield what is new since the last update."""
        taken = [polled.take() for polled in self._polled]
        self.fault = next(filter(None, (polled.fault for polled in self._polled)), "")
        yield from self._show(*taken)

    def close(self) -> None:
        """Unsubscribe."""
        for polled in self._polled:
            polled.close()


def _show_states() -> Show:
    """Each transition of the grasp, in order; diagnostics and the speed of the simulation once a second."""
    steps: deque[dict[str, Any]] = deque(maxlen=40)
    nodes: dict[str, tuple[float, DiagnosticStatus]] = {}
    speed: float | None = None
    sent_at = 0.0

    def show(status: list[GraspStatus], diagnostics: list[DiagnosticArray], speeds: list[Float64]) -> Items:
        nonlocal sent_at, speed
        steps.extend(_step(message) for message in status)
        if status:
            yield "grasp", _text("grasp", steps=list(steps))
        now = time.monotonic()
        for message in diagnostics:
            nodes.update({status.name: (now, status) for status in message.status})
        speed = speeds[-1].data if speeds else speed
        if now - sent_at > 1.0:
            sent_at = now
            health = [_health(status, now - at) for at, status in nodes.values()]
            yield "health", _text("health", nodes=sorted(health, key=itemgetter("name")), speed=speed)
            speed = None

    return show


def _show_robot(description: RobotDescription) -> Show:
    """Poses of the links when they have changed; held objects when they have."""
    shown: list[float] = []

    def show(states: list[JointState], attached: list[MarkerArray]) -> Items:
        nonlocal shown
        joints = joints_from_msg(states[-1]) if states else None
        known = joints is not None and len(shown) == len(joints.position)
        if joints is not None and not (known and np.allclose(joints.position, shown, atol=2e-5)):
            shown = list(joints.position)
            q = dict(zip(joints.name, joints.position, strict=True))
            yield "robot", wire.frame({"kind": "robot"}, wire.link_poses(description, q))
        if attached:
            boxes = [wire.box(b.name, b.T_link_box, b.size, link=b.link) for b in held_from_msg(attached[-1])]
            yield "held", _text("held", boxes=boxes)

    return show


def _newest(payload: Callable[[Any], str | bytes], key: str) -> Callable[[], Show]:
    """How to show the newest message of one source alone."""

    def show(messages: list[Any]) -> Items:
        if messages:
            yield key, payload(messages[-1])

    return lambda: show


def _image(camera: str, image: Image) -> bytes:
    """A picture as JPEG."""
    return wire.frame({"kind": "image", "camera": camera}, wire.jpeg(rgb_image(image)))


def _show_cloud(description: RobotDescription, camera: CameraConfig) -> Show:
    """The cloud of the newest frame with both depth and colour, one point a centimetre."""
    states = RobotStateBuffer(description)
    deprojector = Deprojector(DepthLimits(near=camera.near, far=camera.far))
    newest: list[Any] = [None, None, None]

    def show(static: list[TFMessage], *images: list[Any]) -> Items:
        for message in static:
            for edge in message.transforms:
                states.set_static(edge.header.frame_id, edge.child_frame_id, transform_to_matrix(edge.transform))
        newest[:] = [taken[-1] if taken else kept for taken, kept in zip(images, newest, strict=True)]
        depth, color, info = newest
        if depth is None or color is None or info is None or depth.header.stamp != color.header.stamp:
            return  # the other half of the frame comes soon
        T_base_optical = states.lookup(description.base, camera.optical_frame, stamp_to_ns(depth.header.stamp))
        lens = lens_from_info(info)
        pixels, rgb = depth_of(depth, lens), color_of(color, lens)
        points, colors = wire.thin_cloud(deprojector, pixels, rgb, lens.intrinsics, T_base_optical)
        newest[0] = None  # shown
        yield "cloud", wire.frame({"kind": "cloud", "count": len(points)}, points, colors)

    return show


def _map(message: Octomap) -> bytes:
    """Occupied cells of a map."""
    leaves = decode(np.frombuffer(message.data, np.uint8), message.resolution, binary=message.binary, tree=message.id)
    cells = wire.occupied_cells(leaves)
    return wire.frame({"kind": "map", "count": len(cells)}, cells)


def _detections(message: Detection3DArray) -> str:
    """Objects as they are detected now."""
    return _text("detections", boxes=[_detection_box(item) for item in message.detections if item.results])


def _show_plans() -> Show:
    """Paths of the tools: of the plan that waits for a person, else of the newest one."""
    waits = False

    def show(previews: list[MarkerArray], grasps: list[MarkerArray]) -> Items:
        nonlocal waits
        waiting = [marker for marker in grasps[-1].markers if marker.ns.startswith("plan/")] if grasps else []
        waits = bool(waiting) if grasps else waits
        if waiting:
            yield "plan", _plan(waiting)
        elif previews and not waits:
            yield "plan", _plan(previews[-1].markers)

    return show


def _plan(markers: Sequence[Marker]) -> str:
    lines = [marker for marker in markers if marker.type == Marker.LINE_STRIP]
    return _text("plan", ways=[np.round([xyz(p) for p in line.points], 4).tolist() for line in lines if line.points])


def makers(
    description: RobotDescription, cameras: Sequence[CameraConfig], cloud: str
) -> dict[str, Callable[[Node], Layer]]:
    """How to make each layer, by its name; `image:NAME` for each camera.

    Args:
        description: The robot.
        cameras: All that there are.
        cloud: Name of the camera whose cloud is shown.
    """
    (chosen,) = (camera for camera in cameras if camera.name == cloud)
    status = Source(GraspStatus, "/grasp/status", QoSProfile(depth=20, durability=QOS_LATCHED.durability))
    diagnostics = Source(DiagnosticArray, "/diagnostics", QoSProfile(depth=100))
    detections = Source(Detection3DArray, "/detections_3d", silence=3.0)
    joints = Source(JointState, "/joint_states", silence=1.0)
    static = Source(TFMessage, "/tf_static", QOS_STATIC_TF)
    depth = Source(Image, f"/{cloud}/depth/image_raw", silence=3.0)
    info = Source(CameraInfo, f"/{cloud}/depth/camera_info")
    images = {camera.name: Source(Image, f"/{camera.name}/color/image_raw", silence=3.0) for camera in cameras}

    def maker(make: Callable[[], Show], *sources: Source, period: float = 0.2) -> Callable[[Node], Layer]:
        return lambda node: Layer(node, sources, make(), period)

    fixed = {
        "states": maker(_show_states, status, diagnostics, Source(Float64, "/sim/real_time_factor")),
        "robot": maker(
            lambda: _show_robot(description),
            *(joints, Source(MarkerArray, "/motion/attached_objects", QOS_LATCHED)),
            period=0.04,
        ),
        "detections": maker(_newest(_detections, "detections"), detections),
        "plan": maker(
            _show_plans,
            *(Source(MarkerArray, topic, QOS_LATCHED) for topic in ("/motion/preview", "/grasp/markers")),
        ),
        "map": maker(_newest(_map, "map"), Source(Octomap, "/octomap_binary", QOS_LATCHED, silence=5.0), period=0.5),
        "cloud": maker(lambda: _show_cloud(description, chosen), *(static, depth, images[cloud], info), period=0.25),
    }
    pictures = {
        f"image:{name}": maker(_newest(partial(_image, name), f"image:{name}"), source)
        for name, source in images.items()
    }
    return fixed | pictures


def _text(kind: str, **values: Any) -> str:
    try:
        return json.dumps({"kind": kind, **values}, allow_nan=False)
    except ValueError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{kind}: a value is not finite") from error


def _step(message: GraspStatus) -> dict[str, Any]:
    names = ("state", "previous_state", "reason", "attempt", "label", "arm", "plan_id")
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


def _detection_box(detection: Any) -> dict[str, Any]:
    best = detection.results[0].hypothesis
    size = detection.bbox.size
    pose = pose_to_matrix(detection.bbox.center)
    return wire.box(best.class_id, pose, (size.x, size.y, size.z), score=round(best.score, 3))
