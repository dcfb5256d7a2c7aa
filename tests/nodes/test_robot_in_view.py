# SPDX-License-Identifier: Apache-2.0
"""Nodes `detector` and `cloud` with something in the hand: a red box in front of a table, 0.5 m below the camera."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from tf2_msgs.msg import TFMessage
from vision_msgs.msg import Detection2DArray, Detection3DArray
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import (
    info_from_intrinsics,
    matrix_to_pose,
    matrix_to_transform,
    ns_to_stamp,
    points_from_cloud,
)
from openarm_common.ros.images import array_to_image, image_to_array
from openarm_common.ros.labelled_clouds import labelled_cloud_from_msg
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR, reliable
from openarm_perception.ros.cloud_node import CloudNode
from openarm_perception.ros.detector_node import DetectNode

BASE_FRAME = RobotDescription.load().base

MS = 1_000_000
ROBOT = RobotDescription.load()
JOINTS = ROBOT.group_state("both_arms", "home") | {ROBOT.finger_joint(side): 0.044 for side in ("left", "right")}
TCP = "openarm_right_hand_tcp"
T_BASE_TCP = ROBOT.link_pose(TCP, JOINTS)
CAMERA = load_cameras()["overhead"]
FRAME, K = CAMERA.optical_frame, CAMERA.intrinsics
#: The box has edges of 4 cm, its middle in the tool frame, its top 0.48 m below the camera; the table is 0.8 m below.
TOP, TABLE = 0.48, 0.80
HALF = round(0.02 * K.fx / TOP)
PATCH = (slice(240 - HALF, 240 + HALF), slice(320 - HALF, 320 + HALF))


class Bench:
    """Camera, joint states, what the hand holds; a node; and what it says."""

    def __init__(self, ros, node_type, kind, topic: str, **params) -> None:
        self.ros, self.said = ros, {}
        self.images = {
            "color/image_raw": ros.node.create_publisher(Image, "/overhead/color/image_raw", QOS_SENSOR),
            "depth/image_raw": ros.node.create_publisher(Image, "/overhead/depth/image_raw", QOS_SENSOR),
            "depth/camera_info": ros.node.create_publisher(CameraInfo, "/overhead/depth/camera_info", QOS_SENSOR),
        }
        self.joints = ros.node.create_publisher(JointState, "/joint_states", QOS_COMMAND)
        self.held = ros.node.create_publisher(MarkerArray, "/motion/attached_objects", QOS_LATCHED)
        self.static = ros.node.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        R = se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
        T = se3.make(R, T_BASE_TCP[:3, 3] + (0.0, 0.0, 0.5))
        edges = (
            (BASE_FRAME, "overhead_link", T @ se3.inverse(T_LINK_OPTICAL)),
            ("overhead_link", FRAME, T_LINK_OPTICAL),
        )
        self.static.publish(TFMessage(transforms=[matrix_to_transform(*edge, 0) for edge in edges]))
        self.rgb = np.full((480, 640, 3), (180, 176, 170), np.uint8)
        self.depth = np.full((480, 640), round(TABLE * 1e3), np.uint16)
        self.rgb[PATCH], self.depth[PATCH] = (205, 25, 25), round(TOP * 1e3)
        self.node = ros.start(node_type, **params)
        self.got = ros.hear(kind, topic, QOS_SENSOR if kind is PointCloud2 else 10)
        self.heard = ros.node.create_subscription(DiagnosticArray, "/diagnostics", self._on_said, reliable(10))
        self.t_ns = 1_000 * MS
        ros.spin_until(self.images["depth/image_raw"].get_subscription_count, what="the camera is listened to")

    def _on_said(self, message: DiagnosticArray) -> None:
        for status in message.status:
            self.said = {item.key: item.value for item in status.values} | {"message": status.message}

    def hold(self) -> None:
        pose = matrix_to_pose(se3.inverse(T_BASE_TCP) @ se3.make(None, T_BASE_TCP[:3, 3]))
        marker = Marker(ns="right/red", type=Marker.CUBE, pose=pose)
        marker.header.frame_id = TCP
        marker.scale.x = marker.scale.y = marker.scale.z = 0.04
        self.held.publish(MarkerArray(markers=[Marker(action=Marker.DELETEALL), marker]))

    def pump(self, condition, what: str, *, joints: bool = True) -> None:
        """A frame every 0.2 s, with joint states just before and after its stamp, until `condition` holds."""

        def send() -> None:
            self.t_ns += 200 * MS
            for offset in (-8, 2) if joints else ():
                state = JointState(name=list(JOINTS), position=list(JOINTS.values()))
                state.header.stamp = ns_to_stamp(self.t_ns + offset * MS)
                self.joints.publish(state)
            self.images["color/image_raw"].publish(array_to_image(self.rgb, "rgb8", FRAME, self.t_ns))
            self.images["depth/image_raw"].publish(array_to_image(self.depth, "16UC1", FRAME, self.t_ns))
            self.images["depth/camera_info"].publish(info_from_intrinsics(K, FRAME, self.t_ns))

        self.ros.send_until(send, 0.2, condition, what)


def detector(ros, **params) -> Bench:
    height = float(T_BASE_TCP[2, 3]) + 0.5 - TABLE
    return Bench(ros, DetectNode, Detection3DArray, "/detections_3d", table_height=height, **params)


@pytest.mark.requirement("P-04", "P-05")
def test_what_motion_holds_is_no_object_on_the_table(ros) -> None:
    """Reported until motion says that it is held; then found in the image alone, counted, and out of the mask."""
    bench = detector(ros)
    bench.pump(lambda: bench.got and bench.got[-1].detections, "the box is taken for an object")
    clouds = ros.hear(PointCloud2, "/detection_points", QOS_SENSOR)
    in_image = ros.hear(Detection2DArray, "/detections_2d")
    masks = ros.hear(Image, "/detection_mask", QOS_SENSOR)
    bench.pump(lambda: masks, "a mask")
    mask = image_to_array(masks[-1])
    assert (masks[-1].encoding, mask.shape) == ("mono8", (480, 640))
    assert (mask[PATCH] == 1).all()
    assert np.count_nonzero(mask) == (2 * HALF) ** 2
    bench.pump(lambda: clouds and clouds[-1].width, "its points")
    cloud = labelled_cloud_from_msg(clouds[-1])
    assert clouds[-1].header.frame_id == FRAME
    assert np.count_nonzero(cloud.labels == 1) > 0.8 * (2 * HALF) ** 2  # without its border, which may float
    bench.hold()
    bench.pump(lambda: not bench.got[-1].detections and bench.said.get("removed/held/right/red"), "it is held")
    assert int(bench.said["removed/held/right/red"]) == (2 * HALF) ** 2
    assert "the robot or what it holds" in bench.said["message"]
    count = len(masks)
    bench.pump(lambda: len(masks) > count + 1 and in_image, "a mask of what is held")
    assert not image_to_array(masks[-1]).any()
    assert len(in_image[-1].detections) == 1


def test_what_was_held_has_the_id_that_it_had_before(ros) -> None:
    bench = detector(ros)
    bench.pump(lambda: bench.got and bench.got[-1].detections, "a detection")
    (before,) = bench.got[-1].detections
    bench.hold()
    bench.pump(lambda: not bench.got[-1].detections, "it is held")
    bench.held.publish(MarkerArray(markers=[Marker(action=Marker.DELETEALL)]))
    bench.pump(lambda: bench.got[-1].detections, "it was let go")
    assert bench.got[-1].detections[0].id == before.id


def test_without_joint_states_objects_are_seen_and_the_lack_is_named(ros) -> None:
    bench = detector(ros, transform_wait=0.2)
    bench.hold()
    bench.pump(lambda: bench.got and bench.got[-1].detections, "a detection", joints=False)
    bench.pump(lambda: "taken for an object" in bench.said.get("message", ""), "the reason", joints=False)
    assert "no /joint_states yet" in bench.said["message"]
    bench.pump(lambda: not bench.got[-1].detections, "joint states come")


def test_the_self_filter_of_the_detector_can_be_switched_off(ros) -> None:
    """Then joint states are not listened to."""
    bench = detector(ros, **{"self_filter.enabled": False})
    bench.hold()
    bench.pump(lambda: bench.got and bench.got[-1].detections, "a detection")
    assert ros.node.count_subscribers("/joint_states") == 0


@pytest.mark.parametrize("organised", [True, False])
@pytest.mark.requirement("P-05")
def test_clouds_without_the_robot_where_asked(ros, organised: bool) -> None:
    """NaN where the hand holds something, the table as it is; without joint states no cloud, and the reason."""
    params = {"self_filter.enabled": True, "organised": organised, "transform_wait": 0.1, "cameras": ["overhead"]}
    bench = Bench(ros, CloudNode, PointCloud2, "/overhead/depth/points", **params)
    bench.pump(lambda: "cannot be cut out" in bench.said.get("message", ""), "the reason", joints=False)
    assert bench.got == []
    bench.hold()
    bench.pump(lambda: bench.got and bench.said.get("overhead_removed/held/right/red"), "a cloud")
    removed = sum(int(n) for key, n in bench.said.items() if "_removed/" in key)
    assert removed >= int(bench.said["overhead_removed/held/right/red"]) == (2 * HALF) ** 2
    points = points_from_cloud(bench.got[-1])
    if not organised:
        assert points.shape[0] == 480 * 640 - removed
        return
    hidden = np.isnan(points[..., 2])
    assert hidden[PATCH].all()
    assert np.count_nonzero(hidden) == removed
    np.testing.assert_allclose(points[5, 5, 2], TABLE, atol=1e-6)
