# SPDX-License-Identifier: Apache-2.0
"""Drafts of a robot whose arm and hand are MJCFs of their own, with a linkage, on a stand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import yaml

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import read_folder
from openarm_motion.config import MotionConfig, MotionLimits
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.moves import RequestBoxes, to_joints
from openarm_sim_bridge.drafting.check import folder_faults
from openarm_sim_bridge.drafting.collisions import coarse_hull
from openarm_sim_bridge.drafting.draft import draft_folder
from openarm_sim_bridge.drafting.edits import Edits
from openarm_sim_bridge.drafting.mesh_files import write_stl
from openarm_sim_bridge.drafting.mjcf import compiled

ARM = """<mujoco><compiler angle="radian"/><asset><mesh file="part.stl"/></asset><worldbody>
  <body name="base"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
    <body name="upper" pos="0 0 0.2"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
      <joint name="lift" axis="0 1 0" range="-6 6"/>
      <geom type="mesh" mesh="part" contype="0" conaffinity="0"/><geom name="thin" type="sphere" size="0.01"/>
      </body></body></worldbody>
  <actuator><motor joint="lift" forcelimited="true" forcerange="-30 30"/></actuator></mujoco>"""
HAND = """<mujoco><compiler angle="radian"/><worldbody>
  <body name="palm"><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/><geom type="box" size="0.02 0.02 0.02"/>
    <body name="drive" pos="0 0.05 0.05"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
      <joint name="drive" axis="1 0 0" range="0 0.8"/>
      <body name="bar" pos="0 0 0.02"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="bar" axis="1 0 0" range="0 1"/></body>
      <body name="tip" pos="0 0 0.05"><inertial pos="0 0 0" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="tip" axis="1 0 0" range="-0.8 0"/>
        <geom name="pad1" type="box" size="0.01 0.004 0.01"/><geom name="pad2" type="box" size="0.01 0.004 0.01"/>
      </body></body></body></worldbody></mujoco>"""
EDITS: dict[str, Any] = {
    "base": "my_stand",
    "prefix": "my_",
    "stand": [0.1, 0.0, 0.4],
    "turn": 1.5707963267948966,
    "attach": [{"file": "hand.xml", "body": "my_upper", "prefix": "grip_", "xyz": [0, 0, 0.3], "rpy": [0, 1.0, 0]}],
    "mimic": {"grip_tip": {"joint": "grip_drive", "multiplier": -1.0}},
    "fixed": ["grip_bar"],
    "velocity": {"*": 2.0},
    "effort": {"grip_*": 5.0},
    "range": {"my_*": [-3.0, 3.0]},
    "hulls": ["my_upper"],
    "add": {"my_base": [{"name": "foot", "size": [0.2, 0.2, 0.1]}]},
    "replace": {"grip_pad1": {"name": "grip_tip_pad_collision", "size": [0.02, 0.008, 0.02]}, "grip_pad2": None},
    "frames": {"my_tcp": {"parent": "grip_palm", "xyz": [0, 0, 0.1]}},
}


@pytest.fixture
def parts(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    vertices = rng.normal(size=(4, 3)) * 0.05
    write_stl(tmp_path / "part.stl", vertices, np.array([(0, 1, 2), (0, 3, 1), (1, 3, 2), (0, 2, 3)]))
    (tmp_path / "arm.xml").write_text(ARM)
    (tmp_path / "hand.xml").write_text(HAND)
    (tmp_path / "edits.yaml").write_text(yaml.safe_dump(EDITS))
    return tmp_path


@pytest.mark.requirement("B-07")
def test_a_hand_of_its_own_is_attached_and_all_stands_where_the_edits_say(parts: Path) -> None:
    folder = parts / "robots" / "mine"
    draft_folder(folder, parts / "arm.xml", {"mine": ("my_base", "my_tcp")}, parts / "edits.yaml", samples=50)
    robot = RobotDescription.from_files(folder / "mine.urdf")
    model = compiled(parts / "arm.xml", Edits.model_validate(EDITS))
    data = mujoco.MjData(model)
    for lift, drive in ((0.0, 0.0), (0.7, 0.5), (-1.1, 0.8)):
        for name, value in {"my_lift": lift, "grip_drive": drive, "grip_tip": -drive}.items():
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_forward(model, data)
        for link in ("my_upper", "grip_palm", "grip_bar", "grip_tip"):
            T = robot.link_pose(link, {"my_lift": lift, "grip_drive": drive})
            np.testing.assert_allclose(T[:3, 3], data.body(link).xpos, atol=1e-9)
            np.testing.assert_allclose(T[:3, :3], data.body(link).xmat.reshape(3, 3), atol=1e-9)
    np.testing.assert_allclose(robot.link_pose("my_base", {})[:3, 3], (0.1, 0.0, 0.4), atol=1e-9)
    arm = yaml.safe_load((folder / "robot.yaml").read_text())["arms"]["mine"]
    assert (arm["joints"], arm["finger_joint"], arm["fingers"]) == (["my_lift"], "grip_drive", ["grip_tip"])


def test_joints_and_shapes_are_as_the_edits_say(parts: Path) -> None:
    folder = parts / "robots" / "mine"
    draft_folder(folder, parts / "arm.xml", {"mine": ("my_base", "my_tcp")}, parts / "edits.yaml", samples=50)
    robot = RobotDescription.from_files(folder / "mine.urdf")
    lift, drive, tip = (robot.joints[name] for name in ("my_lift", "grip_drive", "grip_tip"))
    assert (lift.lower, lift.upper, lift.effort) == (-3.0, 3.0, 30.0)
    assert (drive.effort, tip.mimic, tip.multiplier) == (5.0, "grip_drive", -1.0)
    assert "grip_bar" not in robot.joints
    assert [s.name for s in robot.links["grip_tip"].collision] == ["grip_tip_pad_collision"]
    assert [s.name for s in robot.links["my_base"].collision] == ["my_base_foot_collision"]
    (hull,) = robot.links["my_upper"].collision
    assert hull.corners is not None
    assert len(hull.corners) == 4


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"attach": [{"file": "hand.xml", "body": "wrist"}]}, "edits.attach: no body 'wrist'"),
        ({"attach": [{"file": "none.xml", "body": "my_upper"}]}, "none.xml"),
        ({"mimic": {"grip_tip": {"joint": "grip_x"}}}, "edits.mimic: no joint 'grip_x'"),
        ({"add": {"my_x": []}}, "edits.add: no link 'my_x'"),
    ],
)
def test_what_is_not_there_is_named(parts: Path, wrong: dict[str, Any], words: str) -> None:
    (parts / "edits.yaml").write_text(yaml.safe_dump(EDITS | wrong))
    with pytest.raises(OpenArmError, match=words) as caught:
        draft_folder(
            parts / "mine", parts / "arm.xml", {"mine": ("my_base", "my_tcp")}, parts / "edits.yaml", samples=5
        )
    assert caught.value.code is Code.CONFIG_INVALID


@pytest.mark.requirement("B-13")
def test_an_arm_without_a_hand_is_a_robot_to_plan_for(parts: Path) -> None:
    edits = {"velocity": {"*": 2.0}, "frames": {"tool": {"parent": "upper", "xyz": [0, 0, 0.3]}}}
    (parts / "edits.yaml").write_text(yaml.safe_dump(edits))
    folder = parts / "bare"
    draft_folder(folder, parts / "arm.xml", {"bare": ("base", "tool")}, parts / "edits.yaml", samples=5)
    assert folder_faults(folder) == []
    robot = RobotDescription.from_files(folder / "bare.urdf", folder / "bare.srdf").of_folder(
        "bare", read_folder(folder)
    )
    assert (robot.arm("bare").controlled, robot.hands) == (("lift",), {})
    with pytest.raises(OpenArmError, match="'bare' of robot 'bare' has no hand"):
        robot.hand("bare")
    config = MotionConfig(limits=MotionLimits(velocity=(1.0,), acceleration=(3.0,), jerk=(30.0,)))
    arm = Arm("bare", robot, config)
    assert to_joints(arm, arm.start_state({"lift": 0.0}), [0.5], RequestBoxes()).q[-1].tolist() == [0.5]


def test_a_coarse_hull_has_few_triangles_around_the_mesh() -> None:
    points = np.random.default_rng(1).normal(size=(4000, 3))
    points *= 0.06 / np.linalg.norm(points, axis=1, keepdims=True)
    corners, triangles = coarse_hull(points)
    assert len(triangles) <= 300
    a, b, c = (corners[triangles[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    outside = np.einsum("pfj,fj->pf", points[:, None] - a, normals)
    assert float(np.max(outside)) < 1e-3
    assert float(np.max(np.linalg.norm(corners, axis=1))) < 0.075
