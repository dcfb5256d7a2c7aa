# SPDX-License-Identifier: Apache-2.0
"""The description against the number table of OpenArm v1.0 (tool centre point of 2026), written down here once more."""

from __future__ import annotations

import io

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yourdfpy

from openarm_common import se3
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_sim_bridge.world.model import PhysicsConfig, robot_spec
from tests.refusals import refused

BASE_LINK = RobotDescription.load().base
SIDES = RobotDescription.load().arm_names
mirror = RobotDescription.load().mirrored

HALF_PI = np.pi / 2

# Right arm: offset of the joint frame, its roll, axis, limits (rad), effort (N m), velocity (rad/s).
ARM = [
    ((0, 0, 0.0625), 0, (0, 0, 1), (-1.396263, 3.490659), 40, 16.754666),
    ((-0.0301, 0, 0.06), HALF_PI, (-1, 0, 0), (-0.174533, 3.316125), 40, 16.754666),
    ((0.0301, 0, 0.06625), 0, (0, 0, 1), (-1.570796, 1.570796), 27, 5.445426),
    ((0, 0.0315, 0.15375), 0, (0, 1, 0), (0, 2.443461), 27, 5.445426),
    ((0, -0.0315, 0.0955), 0, (0, 0, 1), (-1.570796, 1.570796), 7, 20.943946),
    ((0.0375, 0, 0.1205), 0, (1, 0, 0), (-0.785398, 0.785398), 7, 20.943946),
    ((-0.0375, 0, 0), 0, (0, 1, 0), (-1.570796, 1.570796), 7, 20.943946),
]
IN_LINK7 = {"link8": (1e-6, 0.0205, 0), "hand": (0, 0, 0.1025), "hand_tcp": (0, 0, 0.1801)}
LINK_NAMES = {"world", BASE_LINK} | {
    f"openarm_{side}_{link}"
    for side in SIDES
    for link in [*(f"link{i}" for i in range(9)), "hand", "hand_tcp", "left_finger", "right_finger"]
}


def table_frames(side: str, q: Array, finger: float) -> dict[str, Array]:
    """Every frame of one arm, (4, 4) in the world, from the table alone."""
    left = side == "left"
    sign = -1.0 if left else 1.0
    T = se3.make(se3.rot_x(sign * HALF_PI), (0, -sign * 0.031, 0.698))
    frames = {"link0": T}
    for i, (offset, roll, axis, *_) in enumerate(ARM):
        turn = -1.0 if left and i == 6 else 1.0
        T = T @ se3.make(se3.rot_x(sign * roll), offset) @ se3.make(se3.exp_so3(turn * q[i] * np.array(axis)))
        frames[f"link{i + 1}"] = T
    for name, offset in IN_LINK7.items():
        frames[name] = T @ se3.make(None, offset)
    for name, outward in (("left_finger", 1), ("right_finger", -1)):
        frames[name] = T @ se3.make(None, (0, outward * (0.005 + finger), 0.1025))
    return {f"openarm_{side}_{name}": pose for name, pose in frames.items()}


def closed_form_tcp(q: Array) -> Array:
    """Tool centre point of the right arm: three spheres of axes, 0.220, 0.216 and 0.1801 m apart."""
    x, y, z = se3.rot_x, se3.rot_y, se3.rot_z
    upper = x(HALF_PI) @ z(q[0]) @ x(HALF_PI - q[1]) @ z(q[2])
    fore = upper @ y(q[3])
    hand = fore @ z(q[4]) @ x(q[5]) @ y(q[6])
    position = np.array([0, -0.1535, 0.698]) + 0.220 * upper[:, 2] + 0.216 * fore[:, 2] + 0.1801 * hand[:, 2]
    return se3.make(hand, position)


@pytest.fixture(scope="module")
def model(description: RobotDescription) -> mujoco.MjModel:
    return robot_spec(description, PhysicsConfig()).compile()


@pytest.fixture(scope="module")
def configurations(description: RobotDescription) -> list[dict[str, float]]:
    """60 random configurations within the limits, by joint name."""
    rng = np.random.default_rng(7)
    names = [name for name, joint in description.joints.items() if joint.type != "fixed" and joint.mimic is None]
    lower, upper = description.limits(names)
    return [dict(zip(names, rng.uniform(lower, upper), strict=True)) for _ in range(60)]


def expected(description: RobotDescription, q: dict[str, float]) -> dict[str, Array]:
    frames: dict[str, Array] = {BASE_LINK: np.eye(4)}
    for side in SIDES:
        arm = np.array([q[name] for name in description.arm_joints(side)])
        frames |= table_frames(side, arm, q[description.finger_joint(side)])
    return frames


def positions(description: RobotDescription, q: dict[str, float]) -> dict[str, float]:
    """Of all joints that move, those that follow others too."""
    return {name: q[joint.mimic or name] for name, joint in description.joints.items() if joint.type != "fixed"}


@pytest.mark.requirement("A-06", "A-12")
def test_forward_kinematics_of_the_suite_mujoco_and_pinocchio_equal_the_table(
    description: RobotDescription, model: mujoco.MjModel, configurations: list[dict[str, float]]
) -> None:
    data, pin_model = mujoco.MjData(model), pin.buildModelFromXML(description.urdf)
    pin_data = pin_model.createData()
    worst = dict.fromkeys(("suite", "mujoco", "pinocchio"), 0.0)
    for q in configurations:
        x = pin.neutral(pin_model)
        for name, value in positions(description, q).items():
            data.qpos[model.joint(name).qposadr[0]] = value
            x[pin_model.joints[pin_model.getJointId(name)].idx_q] = value
        mujoco.mj_kinematics(model, data)
        pin.framesForwardKinematics(pin_model, pin_data, x)
        own, table = description.link_poses(q), expected(description, q)
        for name, T in table.items():
            body, frame = data.body(name), pin_model.getFrameId(name, pin.FrameType.BODY)
            other = {"suite": own[name], "mujoco": se3.make(body.xmat.reshape(3, 3), body.xpos)}
            other["pinocchio"] = pin_data.oMf[frame].homogeneous
            worst = {key: max(worst[key], float(np.abs(found - T).max())) for key, found in other.items()}
        for side in SIDES:
            tcp = description.tcp_link(side)
            np.testing.assert_allclose(data.site(tcp).xpos, table[tcp][:3, 3], atol=1e-6)
    assert worst["suite"] < 1e-9
    assert max(worst.values()) < 1e-6, worst


@pytest.mark.requirement("A-06")
def test_tcp_equals_the_closed_form_and_the_left_arm_is_its_mirror_image(
    description: RobotDescription, configurations: list[dict[str, float]]
) -> None:
    flip = np.diag([1.0, -1.0, 1.0])
    for q in configurations:
        right = np.array([q[name] for name in description.arm_joints("right")])
        T = closed_form_tcp(right)
        np.testing.assert_allclose(description.link_pose("openarm_right_hand_tcp", q), T, atol=1e-6)
        left = dict(zip(description.arm_joints("left"), mirror(right), strict=True))
        T_mirror = se3.make(flip @ T[:3, :3] @ flip, flip @ T[:3, 3])
        np.testing.assert_allclose(description.link_pose("openarm_left_hand_tcp", left), T_mirror, atol=1e-6)


def test_world_positions_at_zero(description: RobotDescription) -> None:
    poses = description.link_poses(dict.fromkeys(description.joints, 0.0))
    for side, sign in (("right", -1.0), ("left", 1.0)):
        np.testing.assert_allclose(poses[f"openarm_{side}_hand_tcp"][:3, 3], [0, sign * 0.1535, 0.0819], atol=1e-9)
        np.testing.assert_allclose(poses[f"openarm_{side}_hand_tcp"][:3, :3], se3.rot_x(np.pi), atol=1e-9)


@pytest.mark.requirement("A-06")
def test_link_names_are_those_users_know(description: RobotDescription) -> None:
    assert set(description.links) == LINK_NAMES
    assert description.root == "world"
    assert set(description.joints) == (
        {"openarm_body_world_joint"}
        | {f"openarm_{s}_openarm_body_link0_joint" for s in SIDES}
        | {f"openarm_{s}_joint{i}" for s in SIDES for i in range(1, 9)}
        | {f"{s}_openarm_hand_joint" for s in SIDES}
        | {f"openarm_{s}_hand_tcp_joint" for s in SIDES}
        | {f"openarm_{s}_finger_joint{i}" for s in SIDES for i in (1, 2)}
    )


@pytest.mark.requirement("A-06")
def test_names_and_limits_are_equal_in_table_urdf_mujoco_and_pinocchio(
    description: RobotDescription, model: mujoco.MjModel
) -> None:
    pin_model = pin.buildModelFromXML(description.urdf)
    moving = {name for name, joint in description.joints.items() if joint.type != "fixed"}
    assert moving == {model.joint(i).name for i in range(model.njnt)} == set(pin_model.names) - {"universe"}
    for side in SIDES:
        for i, (name, row) in enumerate(zip(description.arm_joints(side), ARM, strict=True)):
            low, high = row[3]
            if side == "left" and i < 2:
                low, high = -high, -low
            joint = description.joint(name)
            index = pin_model.joints[pin_model.getJointId(name)].idx_q
            assert (joint.lower, joint.upper) == (low, high)
            assert tuple(model.joint(name).range) == (low, high)
            assert (pin_model.lowerPositionLimit[index], pin_model.upperPositionLimit[index]) == (low, high)
            assert (joint.effort, joint.velocity) == row[4:]
            assert pin_model.upperEffortLimit[index] == row[4]
            assert tuple(model.actuator(name).forcerange) == (-row[4], row[4])
            # targets of soft servos are beyond where joints can be; controllers refuse goals that are
            assert tuple(model.actuator(name).ctrlrange) == (-12.5, 12.5)
        for number in (1, 2):
            finger = description.joint(f"openarm_{side}_finger_joint{number}")
            assert (finger.lower, finger.upper, finger.effort, finger.velocity) == (0.0, 0.044, 333.0, 10.0)


@pytest.mark.requirement("A-06")
def test_yourdfpy_reads_the_same_robot(description: RobotDescription) -> None:
    robot = yourdfpy.URDF.load(io.StringIO(description.urdf), build_scene_graph=True, load_meshes=False)
    assert set(robot.link_map) == set(description.links)
    assert robot.validate()
    q = {name: 0.02 if "finger" in name else 0.3 for name in robot.actuated_joint_names}
    robot.update_cfg(q)
    for name, T in description.link_poses(q).items():
        np.testing.assert_allclose(robot.get_transform(name, "world"), T, atol=1e-9, err_msg=name)


@pytest.mark.requirement("A-13")
def test_collision_is_primitives_and_looks_stay_inside_their_bounds(description: RobotDescription) -> None:
    def bounds(shapes: tuple[object, ...]) -> tuple[Array, Array]:
        corners = []
        for shape in shapes:
            half = np.array(shape.size) / 2 if shape.kind == "box" else np.array([1, 1, 0]) * shape.size[0]
            half = half if shape.kind == "box" else half + np.array([0, 0, shape.size[1] / 2])
            signs = np.array(np.meshgrid(*[(-1, 1)] * 3)).reshape(3, -1).T
            corners.append(se3.apply(shape.T_link_primitive, signs * half))
        points = np.concatenate(corners)
        return points.min(axis=0), points.max(axis=0)

    for name, link in description.links.items():
        assert not link.meshes
        assert bool(link.collision) == bool(link.visual)
        if link.collision:
            (low, high), (seen_low, seen_high) = bounds(link.collision), bounds(link.visual)
            assert (seen_low >= low - 1.5e-4).all(), name
            assert (seen_high <= high + 1.5e-4).all(), name


@pytest.mark.requirement("A-11")
def test_all_names_are_unique(description: RobotDescription, model: mujoco.MjModel) -> None:
    shapes = [s.name for link in description.links.values() for s in link.visual + link.collision]
    assert all(shapes)
    assert len(shapes) == len(set(shapes))
    assert all(model.geom(i).name for i in range(model.ngeom))  # MuJoCo drops the name of a duplicate


def test_masses_and_tensors_are_possible(description: RobotDescription) -> None:
    robot = yourdfpy.URDF.load(io.StringIO(description.urdf), load_meshes=False)
    inertials = {name: link.inertial for name, link in robot.link_map.items() if link.inertial is not None}
    assert sum(inertial.mass for inertial in inertials.values()) == pytest.approx(25.67, abs=0.01)
    for name, inertial in inertials.items():
        a, b, c = np.linalg.eigvalsh(inertial.inertia)
        assert a > 0, name
        assert a + b >= c, name


def test_questions_that_have_no_answer_list_what_there_is(description: RobotDescription) -> None:
    with pytest.raises(OpenArmError, match="no position of joint 'openarm_left_joint1'"):
        description.link_pose("openarm_left_link1", {"openarm_right_joint1": 0.0})
    refused("no link 'hand' in robot 'openarm_v1'; links: world", description.link_pose, "hand", {})
    refused("right_arm/wrist_look", description.group_state, "right_arm", "dance")
    refused("joints: openarm_body_world_joint", description.limits, ["joint1"])
