# SPDX-License-Identifier: Apache-2.0
"""Bench for the node `octomap`: a camera that sees flat sheets, and a subscriber to the map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from octomap_msgs.msg import Octomap
from sensor_msgs.msg import CameraInfo, Image, JointState
from tf2_msgs.msg import TFMessage
from visualization_msgs.msg import MarkerArray

from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras
from openarm_common.octree.codec import decode
from openarm_common.octree.distance_field import field_path
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform, ns_to_stamp
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR, QOS_STATIC_TF
from openarm_octomap.ros.node import OctomapNode

CAMERA = load_cameras()["overhead"]
K, FRAME = CAMERA.intrinsics, CAMERA.optical_frame
ROBOT = RobotDescription.load()
JOINTS = sorted(name for name, joint in ROBOT.joints.items() if joint.type != "fixed" and joint.mimic is None)
T_BASE_CAMERA = CAMERA.T_parent_optical


def sheet(z: float, hole: tuple[float, float, float] | None = None) -> np.ndarray:
    """Depth image (mm) of a horizontal plane at height z; around `hole` x, y within its radius nothing returns."""
    pixels = np.stack(np.meshgrid(np.arange(K.width), np.arange(K.height)), axis=-1)
    rays = K.deproject(pixels, np.ones(pixels.shape[:2]))
    direction = rays @ T_BASE_CAMERA[:3, :3].T
    depth = (z - T_BASE_CAMERA[2, 3]) / np.where(direction[..., 2] < -1e-3, direction[..., 2], np.nan)
    depth[~((depth > 0.2) & (depth < 3.0))] = np.nan
    if hole is not None:
        at = T_BASE_CAMERA[:3, 3] + direction * depth[..., None]
        depth[np.hypot(at[..., 0] - hole[0], at[..., 1] - hole[1]) < hole[2]] = np.nan
    return np.nan_to_num(depth * 1e3).round().astype(np.uint16)


class Bench:
    """A camera, joint states, and a subscriber to the map."""

    def __init__(self, ros, tmp_path: Path, **params) -> None:
        self.ros = ros
        node = ros.node
        self.depth = node.create_publisher(Image, "/overhead/depth/image_raw", QOS_SENSOR)
        self.info = node.create_publisher(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR)
        self.joints = node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self.held = node.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self.static = node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
        edges = ((CAMERA.parent, CAMERA.link_frame, CAMERA.T_parent_link), (CAMERA.link_frame, FRAME, T_LINK_OPTICAL))
        self.static.publish(TFMessage(transforms=[matrix_to_transform(*edge, 0) for edge in edges]))
        self.field = field_path(f"test_{tmp_path.name}")
        all_params = {
            "cameras": ["overhead"], "period": 0.05, "field.name": f"test_{tmp_path.name}", "cloud_topic": "", **params
        }  # fmt: skip
        self.node = ros.start(OctomapNode, **all_params)
        self.maps: list[Octomap] = ros.hear(Octomap, "octomap_binary", QOS_LATCHED)
        self.said: list[DiagnosticArray] = ros.hear(DiagnosticArray, "/diagnostics")
        self.t_ns = 1_000_000_000

    def send(self, image: Image, *, joints: bool = True, info: CameraInfo | None = None) -> None:
        if joints:
            state = JointState(name=list(JOINTS), position=[0.0] * len(JOINTS))
            state.header.stamp = ns_to_stamp(self.t_ns)
            self.joints.publish(state)
        info = info or info_from_intrinsics(K, FRAME, self.t_ns)
        info.header.stamp = ns_to_stamp(self.t_ns)
        self.info.publish(info)
        self.depth.publish(image)

    def show(self, pixels: np.ndarray, condition, what: str, encoding: str = "16UC1", **kwargs) -> None:
        """Publish the same view with new stamps until `condition` holds."""

        def send() -> None:
            self.t_ns += 100_000_000
            image = array_to_image(pixels, encoding, kwargs.get("frame", FRAME), self.t_ns)
            self.send(image, **kwargs.get("send", {}))

        self.ros.send_until(send, 0.1, condition, what)

    def state(self, point: tuple[float, float, float], message: Octomap | None = None) -> str:
        """What a map (the newest one) says of a point."""
        if message is None:
            if not self.maps:
                return "no map"
            message = self.maps[-1]
        corner = np.asarray(point) - message.resolution
        box = Lattice.from_bounds(message.resolution, corner, np.asarray(point) + message.resolution)
        leaves = decode(np.frombuffer(message.data, np.uint8), message.resolution, binary=message.binary)
        value = leaves.on(box)[0][tuple(box.indices(point))]
        return "unknown" if np.isnan(value) else "occupied" if value > 0 else "free"

    def call(self, kind, name: str, request=None):
        return self.ros.call(self.ros.node.create_client(kind, name), request or kind.Request())

    def heard(self, text: str) -> bool:
        return any(text in s.message and s.level == b"\x02" for m in self.said for s in m.status if "octomap" in s.name)

    def value(self, key: str) -> str:
        statuses = [s for m in self.said for s in m.status if "octomap" in s.name]
        return next((v.value for s in reversed(statuses) for v in s.values if v.key == key), "")
