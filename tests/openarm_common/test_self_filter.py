# SPDX-License-Identifier: Apache-2.0
"""The robot and what it holds in images and clouds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics, load_cameras
from openarm_common.camera.depth_view import DepthView
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from tests.refusals import refused

ROBOT = RobotDescription.load()
JOINTS = {name: 0.0 for name, joint in ROBOT.joints.items() if joint.type != "fixed"}
K = Intrinsics.from_fovy(160, 120, 60.0)

ONE_LINK = """
<robot name="one"><link name="base"/><link name="arm"><collision name="c">
<geometry>{geometry}</geometry></collision></link>
<joint name="j" type="fixed"><parent link="base"/><child link="arm"/><origin xyz="0.1 -0.05 1.0" rpy="0.4 0.7 0.2"/>
</joint></robot>
"""
GEOMETRY = {
    "box": '<box size="0.2 0.3 0.1"/>',
    "cylinder": '<cylinder radius="0.1" length="0.3"/>',
    "sphere": '<sphere radius="0.15"/>',
}


def truth(kind: str, points: np.ndarray, padding: float) -> np.ndarray:
    """Points (..., 3) of the base that lie in the padded shape."""
    T = RobotDescription.from_urdf(ONE_LINK.format(geometry=GEOMETRY[kind])).link_pose("arm", {})
    x, y, z = np.moveaxis(se3.apply(se3.inverse(T), points), -1, 0)
    if kind == "box":
        half = np.array([0.1, 0.15, 0.05]) + padding
        return (np.abs(x) <= half[0]) & (np.abs(y) <= half[1]) & (np.abs(z) <= half[2])
    if kind == "cylinder":
        return (np.hypot(x, y) <= 0.1 + padding) & (np.abs(z) <= 0.15 + padding)
    return x * x + y * y + z * z <= (0.15 + padding) ** 2


@settings(max_examples=40)
@given(st.sampled_from(list(GEOMETRY)), st.integers(0, 2**32 - 1))
@pytest.mark.requirement("P-05")
def test_pixels_in_the_padded_shape_and_no_others_are_labelled(kind: str, seed: int) -> None:
    """Any pose of the camera, also inside the shape or next to it."""
    rng = np.random.default_rng(seed)
    description = RobotDescription.from_urdf(ONE_LINK.format(geometry=GEOMETRY[kind]))
    robot = SelfFilter(description, SelfFilterConfig(padding=0.03))
    T = se3.make(se3.exp_so3(rng.normal(size=3) * 1.5), np.array([0.1, -0.05, 1.0]) + rng.normal(size=3) * 0.3)
    depth = rng.uniform(0.05, 0.8, (120, 160)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.2] = np.nan
    scan = DepthView(depth, K, T, 0.05, 3.0)
    label, counts = robot.label_depth(scan, robot.shapes({}))
    points = se3.apply(T, K.deproject(np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=-1), depth))
    inside, surely = truth(kind, points, 0.03 + 1e-5), truth(kind, points, 0.03 - 1e-5)
    assert (label[surely] == 1).all()
    assert not (label[~inside] == 1).any()
    assert counts.get("arm", 0) == np.count_nonzero(label == 1)
    cloud = points[np.isfinite(depth)].astype(np.float32)
    of_cloud, counts_of_cloud = robot.label_points(cloud, robot.shapes({}))
    assert abs(counts_of_cloud.get("arm", 0) - counts.get("arm", 0)) <= 2
    assert abs(np.count_nonzero(of_cloud) - np.count_nonzero(label == 1)) <= 2


def test_views_without_a_return_through_the_robot_say_nothing() -> None:
    """A finger too near for the camera must not clear what is behind it."""
    robot = SelfFilter(RobotDescription.from_urdf(ONE_LINK.format(geometry=GEOMETRY["box"])), SelfFilterConfig())
    T = se3.make(None, (0.1, -0.05, 0.0))
    depth = np.zeros((120, 160), np.uint16)
    label, counts = robot.label_depth(DepthView(depth, K, T, 0.05, 3.0), robot.shapes({}))
    assert label[60, 80] == 2
    assert label[5, 5] == 0
    assert counts == {}


def test_each_link_has_a_padding_of_its_own() -> None:
    """And says how many pixels it took."""
    camera = load_cameras()["overhead"]
    depth = np.full((480, 640), 0.62, np.float32)  # a sheet across the hands of the arms at zero
    scan = DepthView(depth, camera.intrinsics, camera.T_parent_optical, 0.2, 3.0)
    plain, wide = (
        SelfFilter(ROBOT, SelfFilterConfig(padding=0.0, link_padding=extra))
        for extra in ((), ("openarm_left_link1=0.05",))
    )
    a, b = (f.label_depth(scan, f.shapes(JOINTS))[1] for f in (plain, wide))
    assert b["openarm_left_link1"] > a["openarm_left_link1"] > 0
    assert b["openarm_right_link1"] == a["openarm_right_link1"] > 0
    refused("names link 'elbow'; links: world, ", SelfFilter, ROBOT, SelfFilterConfig(link_padding=("elbow=0.1",)))
    for wrong in ("openarm_left_hand", "openarm_left_hand=wide", "openarm_left_hand=3"):
        with pytest.raises(ValueError, match="link_padding"):
            SelfFilterConfig(link_padding=(wrong,))


@pytest.mark.requirement("P-04", "P-05")
def test_a_held_box_follows_its_link() -> None:
    robot = SelfFilter(ROBOT, SelfFilterConfig(padding=0.0, held_padding=0.0))
    held = HeldBox("left/cube", "openarm_left_hand_tcp", se3.make(None, (0.0, 0.0, 0.03)), (0.05, 0.05, 0.05))
    for q in (0.0, 0.9):
        joints = JOINTS | {"openarm_left_joint4": q}
        middle = se3.apply(ROBOT.link_pose("openarm_left_hand_tcp", joints), (0.0, 0.0, 0.05))
        cloud = middle[None].astype(np.float32)
        label, counts = robot.label_points(cloud, robot.shapes(joints, [held]))
        assert label.tolist() == [1]
        assert counts == {"held/left/cube": 1}
        assert robot.label_points(cloud, robot.shapes(joints))[1] == {}
    assert refused(None, robot.shapes, JOINTS, [HeldBox("x", "tray", np.eye(4), (1, 1, 1))]).code is Code.NO_TRANSFORM


def test_a_joint_without_a_position_is_named() -> None:
    refused("no position of joint", SelfFilter(ROBOT, SelfFilterConfig()).shapes, {})
