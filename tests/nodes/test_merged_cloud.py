# SPDX-License-Identifier: Apache-2.0
"""Node `cloud`: the merged cloud of both cameras in the base frame, from rendered images of a moving arm."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import CameraInfo, Image, JointState, PointCloud2
from tf2_msgs.msg import TFMessage

from benchmarks.map_scene import MapScene
from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import (
    info_from_intrinsics,
    matrix_to_transform,
    ns_to_stamp,
    points_from_cloud,
    stamp_to_ns,
)
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_SENSOR
from openarm_common.scene.scene import load_scene
from openarm_perception.geometry.merge import CloudMerger
from openarm_perception.ros.cloud_node import CloudNode

BASE_FRAME = RobotDescription.load().base

MS = 1_000_000
#: The wrist camera's image is so much later than that of the overhead camera, and so fast does the arm turn, rad/s.
LATER, SPEED = 40 * MS, 0.4


class Moving:
    """Both cameras over the demo scene, the arm turning about joint 1; and a node that merges their clouds."""

    def __init__(self, ros, **params) -> None:
        self.ros, self.scene = ros, MapScene(load_scene("demo"))
        self.home = self.scene.joints | dict(self.scene.description.group_state("right_arm", "wrist_look"))
        make = ros.node.create_publisher
        self.depth = {n: make(Image, f"/{n}/depth/image_raw", QOS_SENSOR) for n in self.scene.cameras}
        self.info = {n: make(CameraInfo, f"/{n}/depth/camera_info", QOS_SENSOR) for n in self.scene.cameras}
        self.joints = make(JointState, "/joint_states", QOS_COMMAND)
        self.static = make(TFMessage, "/tf_static", QOS_LATCHED)
        edges = [(c.parent, c.optical_frame, c.T_parent_optical) for c in self.scene.cameras.values()]
        self.static.publish(TFMessage(transforms=[matrix_to_transform(*edge, 0) for edge in edges]))
        params = {"self_filter.enabled": True, "transform_wait": 5.0, "merged_age": 10.0, **params}
        self.node = ros.start(CloudNode, **params)
        self.merged: list[PointCloud2] = ros.hear(PointCloud2, "/points", QOS_SENSOR)
        self.images = {}
        for name, after in (("overhead", 0), ("wrist", LATER)):
            self.scene.joints = self.at(after)
            scans = dict(zip(self.scene.cameras, (frame.scan for frame in self.scene.frames(0)), strict=True))
            self.images[name] = (after, scans[name])
        inputs = (self.joints, *self.depth.values(), *self.info.values())
        heard = "the node listens to both cameras and the joints"
        ros.spin_until(lambda: all(pub.get_subscription_count() for pub in inputs), what=heard)

    def at(self, offset_ns: int) -> dict[str, float]:
        name = "openarm_right_joint1"
        return self.home | {name: self.home[name] + SPEED * offset_ns * 1e-9}

    def show(self) -> PointCloud2:
        """Publish both images and the joint states around them until they are merged; the cloud."""
        t_ns = 1_000 * MS

        def send() -> None:
            nonlocal t_ns
            t_ns += 1_000 * MS
            for offset in range(-20, 101, 10):
                q = self.at(offset * MS)
                speed = [SPEED if name == "openarm_right_joint1" else 0.0 for name in q]
                state = JointState(name=list(q), position=list(q.values()), velocity=speed)
                state.header.stamp = ns_to_stamp(t_ns + offset * MS)
                self.joints.publish(state)
            for name, (after, scan) in self.images.items():
                frame = self.scene.cameras[name].optical_frame
                self.depth[name].publish(array_to_image(scan.depth, "16UC1", frame, t_ns + after))
                self.info[name].publish(info_from_intrinsics(scan.intrinsics, frame, t_ns + after))

        def merged() -> bool:
            return any(stamp_to_ns(cloud.header.stamp) % (1_000 * MS) == LATER for cloud in self.merged)

        self.ros.send_until(send, 1.0, merged, "a merged cloud")
        return self.merged[-1]


@pytest.fixture
def moving(ros):
    made: list[Moving] = []

    def make(**params) -> Moving:
        made.append(Moving(ros, **params))
        return made[-1]

    yield make
    for bench in made:
        bench.scene.close()


@pytest.mark.requirement("A-46", "B-61")
def test_the_clouds_of_both_cameras_meet_within_5_mm_though_one_of_them_moves(moving) -> None:
    """Each at its own stamp; with the newest posture of the arm in its place the wrist camera's would not."""
    bench = moving()
    cloud = bench.show()
    assert cloud.header.frame_id == BASE_FRAME
    points = points_from_cloud(cloud).astype(np.float64)
    overhead, wrist = (bench.images[name][1] for name in ("overhead", "wrist"))

    def overlap(points: np.ndarray) -> np.ndarray:
        """How far along its axis the overhead camera sees what others see there too, m."""
        local = se3.apply(se3.inverse(overhead.T_base_camera), points)
        u, v = np.round(overhead.intrinsics.project(local)).T
        inside = (u >= 0) & (u < overhead.intrinsics.width) & (v >= 0) & (v < overhead.intrinsics.height)
        error = np.abs(overhead.depth[v[inside].astype(int), u[inside].astype(int)] * 1e-3 - local[inside, 2])
        return error[error < 0.02]  # the rest is hidden from it

    # points of the overhead camera come first: the wrist camera's begin where they no longer fit its pixels exactly
    local = se3.apply(se3.inverse(overhead.T_base_camera), points)
    pixels = overhead.intrinsics.project(local)
    own = (np.abs(pixels - np.round(pixels)) < 0.01).all(axis=1)
    first = int(np.flatnonzero(~own)[0])
    assert own[:first].all()
    assert min(first, len(points) - first) > 50_000
    error = overlap(points[first:])
    assert len(error) > 50_000
    assert np.percentile(error, 95) <= 0.005
    bench.scene.joints = bench.at(100 * MS)
    newest = bench.scene.T_base_camera("wrist") @ se3.inverse(wrist.T_base_camera)
    bench.scene.joints = bench.at(LATER)
    moved = np.linalg.norm(se3.apply(newest, points[first:]) - points[first:], axis=1)
    assert np.median(moved) > 0.005, "the arm must be fast enough to tell stamps apart"


@pytest.mark.long
@pytest.mark.requirement("A-46", "A-50", "A-51")
def test_filters_hold_for_the_merged_cloud(moving) -> None:
    """One point a cell of 1 cm where both cameras look, also with outliers dropped."""
    cloud = moving(organised=False, **{"filter.voxel": 0.01, "filter.outliers": True}).show()
    points = points_from_cloud(cloud)
    cells = np.floor(points.astype(np.float64) / 0.01 + 1e-6)
    assert 5_000 < len(points) < 100_000
    assert len(np.unique(cells, axis=0)) >= 0.999 * len(points)


@pytest.mark.requirement("A-46")
def test_a_silent_camera_is_left_out_and_back_when_it_speaks() -> None:
    merger, one = CloudMerger(("a", "b"), max_age=0.5), np.zeros((1, 3), np.float32)
    away = se3.make(None, (1.0, 0.0, 0.0))
    assert merger.add("a", 0, one, np.eye(4)) is None
    stamp, points = merger.add("b", 10 * MS, one, away)
    assert (stamp, points.tolist()) == (10 * MS, [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    assert merger.add("a", 100 * MS, one, np.eye(4)) is None
    for t in (600, 700):
        stamp, points = merger.add("a", t * MS, one, np.eye(4))
        assert (stamp, len(points)) == (t * MS, 1)
    assert merger.add("b", 710 * MS, one, away) is None
    stamp, points = merger.add("a", 720 * MS, one, np.eye(4))
    assert (stamp, len(points)) == (720 * MS, 2)
    assert merger.add("a", 0, one, np.eye(4)) is None, "a restarted simulation"
    stamp, points = merger.add("b", 20 * MS, one, away)
    assert (stamp, len(points)) == (20 * MS, 2)
