# SPDX-License-Identifier: Apache-2.0
"""Drafts of robots: from MJCF to URDF with the same motion and shapes, folders, and what is wrong with them."""

from __future__ import annotations

import re
import shutil
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import yaml

from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder, robot_names
from openarm_common.robot.meshes import mesh_file, read_mesh
from openarm_sim_bridge.drafting.check import folder_faults
from openarm_sim_bridge.drafting.draft import draft_folder
from openarm_sim_bridge.drafting.edits import Edits
from openarm_sim_bridge.drafting.mesh_files import _budgets, write_stl
from openarm_sim_bridge.drafting.mjcf import UrdfDraft, compiled
from tests.refusals import refused, refuses

#: Two arms that mirror each other, of a hinge off the origin of its body, a slide, and two fingers that are coupled.
ARM = """
  <body name="{side}_1" pos="0 {y} 0.5" euler="{roll} 0 0">
    <inertial pos="0.1 0.02 0" mass="2" diaginertia="0.1 0.2 0.15"/>
    <joint name="{side}_hinge" pos="0.05 0 0.1" axis="0 {axis} 0" range="-1.5 1.2" damping="0.3" frictionloss="0.1"/>
    <geom type="capsule" size="0.04 0.1" euler="0 1.5707963 0" pos="0.15 0 0"/>
    <geom type="mesh" mesh="part" contype="0" conaffinity="0" rgba="1 0 0 1"/>
    <body name="{side}_2" pos="0.35 0 0" euler="0 0.2 0">
      <inertial pos="0 0 0.1" mass="1" diaginertia="0.01 0.02 0.02"/>
      <joint name="{side}_slide" type="slide" axis="0 0 1" range="-0.1 0.2"/>
      <geom type="mesh" mesh="part" pos="0 0 0.1"/>
      <site name="{side}_tip" pos="0 0 0.3" euler="0 0 0.5"/>
      <body name="{side}_f1" pos="0.02 0 0.2"><inertial pos="0 0 0.02" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="{side}_g1" axis="0 1 0" range="0 0.8"/>
        <geom name="{side}_pad1" type="box" size="0.01 0.01 0.03"/></body>
      <body name="{side}_f2" pos="-0.02 0 0.2"><inertial pos="0 0 0.02" mass="0.1" diaginertia="1e-4 1e-4 1e-4"/>
        <joint name="{side}_g2" axis="0 1 0" range="-0.4 0"/><geom type="box" size="0.01 0.01 0.03"/></body>
    </body></body>"""
MJCF = """<mujoco model="two"><compiler angle="radian"/>
  <asset><mesh name="part" file="part.stl" scale="2 -1 1"/></asset>
  <worldbody><geom type="plane" size="1 1 1"/><geom type="box" size="0.1 0.1 0.2" pos="0 0 0.2"/>{left}{right}
  </worldbody>
  <equality><joint joint1="left_g1" joint2="left_g2" polycoef="0.02 -2 0 0 0"/>
            <joint joint1="right_g2" joint2="right_g1" polycoef="-0.01 -0.5 0 0 0"/></equality>
  <actuator><motor joint="left_hinge" gear="10" forcelimited="true" forcerange="-3 3"/>
    <position joint="left_g1" forcelimited="true" forcerange="-1 1"/><position joint="right_g1"/></actuator></mujoco>"""
EDITS = {
    "base": "foot",
    "velocity": {"*_hinge": 2.0, "*_slide": 0.5, "*_g?": 3.0},
    "replace": {"left_pad1": {"name": "left_f1_pad_collision", "size": [0.01, 0.02, 0.05], "xyz": [0.01, 0, 0]}},
    "boxes": {"foot": [{"name": "block", "size": [0.2, 0.2, 0.4], "xyz": [0, 0, 0.2]}]},
    "frames": {f"{side}_tcp": {"site": f"{side}_tip"} for side in ("left", "right")},
}
ARMS = {side: ("foot", f"{side}_tcp") for side in ("left", "right")}
VERTICES = np.array([(0, 0, 0), (0.03, 0, 0), (0, 0.02, 0), (0, 0, 0.1), (0.01, 0.005, 0.01)], np.float64)
#: A tetrahedron with a dent.
TRIANGLES = np.array([(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 4), (2, 3, 4), (3, 1, 4)])


def write_mjcf(folder: Path) -> Path:
    write_stl(folder / "part.stl", VERTICES, TRIANGLES)
    left = ARM.format(side="left", y=0.2, roll=0.3, axis=1)
    right = ARM.format(side="right", y=-0.2, roll=-0.3, axis=-1)
    path = folder / "two.xml"
    path.write_text(MJCF.format(left=left, right=right), encoding="utf-8")
    return path


@pytest.fixture
def mjcf(tmp_path: Path) -> Path:
    return write_mjcf(tmp_path)


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the draft, which tests copy."""
    source = tmp_path_factory.mktemp("draft")
    edits = source / "edits.yaml"
    edits.write_text(yaml.safe_dump(EDITS))
    out = source / "robots" / "two"
    out.mkdir(parents=True)
    postures = {"home": {"right": [0.1, 0.05], "left": "mirrored"}}
    semantics = {
        "postures": postures,
        "gripper": {"open": 0.3},
        "samples": 100,
        "may_touch": [["{arm}_f1", "{arm}_f2"]],
    }
    (out / "semantics.yaml").write_text(yaml.safe_dump(semantics))
    draft_folder(out, write_mjcf(source), ARMS, edits)
    return out


@pytest.fixture
def folder(two: Path, tmp_path: Path) -> Path:
    return shutil.copytree(two, tmp_path / "robots" / "two")


def assert_same_motion(model: mujoco.MjModel, urdf: str, tolerance: float = 1e-9) -> None:
    """Places of links, and torques of gravity, Coriolis and inertia, in 10 random states."""
    robot, data = pin.buildModelFromXML(urdf), mujoco.MjData(model)
    found, rng = robot.createData(), np.random.default_rng(0)
    followers = {j.name: j for j in RobotDescription.from_urdf(urdf).joints.values() if j.mimic is not None}
    joints = [model.joint(k) for k in range(model.njnt)]
    at = {joint.name: robot.joints[robot.getJointId(joint.name)].idx_q for joint in joints}
    assert robot.nv == model.nv == len(at)
    for _ in range(10):
        value = {j.name: rng.uniform(*j.range) for j in joints}
        value |= {n: f.multiplier * value[str(f.mimic)] + f.offset for n, f in followers.items()}
        speed = rng.normal(size=model.nv)
        q, v = np.zeros(robot.nq), np.zeros(robot.nv)
        for joint in joints:
            data.qpos[joint.qposadr[0]] = q[at[joint.name]] = value[joint.name]
            data.qvel[joint.dofadr[0]] = v[at[joint.name]] = speed[joint.dofadr[0]]
        mujoco.mj_forward(model, data)
        pin.framesForwardKinematics(robot, found, q)
        for body in range(1, model.nbody):
            T = found.oMf[robot.getFrameId(model.body(body).name)]
            offset = model.jnt_pos[model.body_jntadr[body]] if model.body_jntnum[body] else np.zeros(3)
            R = data.xmat[body].reshape(3, 3)
            np.testing.assert_allclose(T.translation, data.xpos[body] + R @ offset, atol=tolerance)
            np.testing.assert_allclose(T.rotation, R, atol=tolerance)
        torque = pin.rnea(robot, found, q, v, np.zeros(robot.nv))
        for joint in joints:
            assert torque[at[joint.name]] == pytest.approx(data.qfrc_bias[joint.dofadr[0]], abs=tolerance)


@pytest.mark.requirement("B-07")
def test_a_urdf_moves_as_the_mjcf_that_it_is_from(mjcf):
    model = compiled(mjcf)
    assert_same_motion(model, UrdfDraft("two", model, Edits.model_validate(EDITS)).text())


def test_joints_have_limits_efforts_damping_and_the_actuated_finger_leads(folder):
    robot = RobotDescription.from_files(folder / "two.urdf")
    joint = robot.joints["left_hinge"]
    assert (joint.lower, joint.upper, joint.velocity, joint.effort) == (-1.5, 1.2, 2.0, 30.0)
    assert '<dynamics damping="0.3" friction="0.1"' in robot.urdf
    left, right = robot.joints["left_g2"], robot.joints["right_g2"]
    assert (left.mimic, left.multiplier, left.offset) == ("left_g1", -0.5, 0.01)
    assert (right.mimic, right.multiplier, right.offset) == ("right_g1", -0.5, -0.01)
    assert robot.joints["right_slide"].effort == 0.0  # not known


def test_shapes_are_where_the_geoms_are_and_meshes_of_one_file_are_one_file(folder, mjcf):
    robot, model = RobotDescription.from_files(folder / "two.urdf"), compiled(mjcf)
    assert sorted(p.name for p in folder.glob("meshes/*/*")) == ["part.stl", "part_hull.stl"]
    assert [s.name for s in robot.links["foot"].collision] == ["foot_block_collision"]
    capsule = robot.links["left_1"].collision
    assert [s.kind for s in capsule] == ["cylinder", "sphere", "sphere"]
    assert robot.links["left_f1"].collision[0].name == "left_f1_pad_collision"
    (hull,) = robot.links["left_2"].collision
    assert hull.corners is not None
    T = hull.T_link_primitive
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    expected = VERTICES[:4] * (2.0, -1.0, 1.0) + (0.0, 0.0, 0.1)
    found = hull.corners @ T[:3, :3].T + T[:3, 3]
    assert sorted(map(tuple, found.round(5) + 0.0)) == sorted(map(tuple, expected.round(5) + 0.0))
    vertices, triangles = read_mesh(folder / "meshes" / "visual" / "part.stl", np.array([1.0, -1.0, 1.0]))
    assert sorted(map(tuple, vertices.round(5) + 0.0)) == sorted(map(tuple, (VERTICES * (2, -1, 1)).round(5) + 0.0))
    assert len(triangles) == len(TRIANGLES)
    tip = robot.link_pose("left_tcp", {"left_hinge": 0.0, "left_slide": 0.0})
    np.testing.assert_allclose(tip[:3, 3], data.site("left_tip").xpos, atol=1e-9)
    np.testing.assert_allclose(tip[:3, :3], data.site("left_tip").xmat.reshape(3, 3), atol=1e-9)


@pytest.mark.parametrize(
    ("find", "replace", "words"),
    [
        (
            'type="slide" axis="0 0 1" range="-0.1 0.2"',
            'type="ball"',
            "a slide; .*, write `fixed: .left_slide.` in edits",
        ),
        ('range="-0.1 0.2"', "", "'left_slide' slides without limits; write `range: {left_slide: .LOWER, UPPER.}` in"),
        ('name="left_hinge"', 'name="left_hinge" ref="0.1"', "'left_hinge' has ref 0.1, expected 0"),
        ('<joint name="left_g1"', '<joint axis="1 0 0"/><joint name="left_g1"', "body 'left_f1' has 2 joints"),
        ("0.02 -2 0", "0.02 -2 1", "no linear coupling"),
        ('<geom type="box" size="0.01', '<geom type="ellipsoid" size="0.01', "ellipsoid, which a URDF cannot have"),
        ('site name="left_tip"', 'site name="other"', "frames.left_tcp: no site 'left_tip'"),
        ("left_pad1", "left_pad9", "edits.replace: no geom 'left_pad1'"),
        ("</worldbody>", "</worldbody", "MuJoCo does not read"),
    ],
)
def test_what_a_urdf_cannot_have_is_named(mjcf, find, replace, words):
    text = mjcf.read_text()
    assert find in text
    mjcf.write_text(text.replace(find, replace, 1))
    with refuses(Code.CONFIG_INVALID, words):
        UrdfDraft("two", compiled(mjcf), Edits.model_validate(EDITS))


def test_edits_fix_what_floats_and_limit_what_has_no_end(mjcf):
    text = mjcf.read_text().replace(' range="-0.1 0.2"', "").replace(' range="-1.5 1.2"', "")
    cart = '<body name="cart"><freejoint name="drive"/><geom type="sphere" size="0.1"/>'
    for find, put in (('<body name="left_1"', cart), ('<body name="right_1"', "</body>")):
        text = text.replace(find, put + find)
    mjcf.write_text(text)
    model = compiled(mjcf)
    with refuses(Code.CONFIG_INVALID, "joint 'drive' is neither .* write `fixed: .drive.` in edits"):
        UrdfDraft("two", model, Edits.model_validate(EDITS))
    more = {"fixed": ["drive"], "range": {"*_slide": [-0.2, 0.1], "left_hinge": [-9.0, 9.0]}}
    text = UrdfDraft("two", model, Edits.model_validate(EDITS | more)).text()
    joints = RobotDescription.from_urdf(text).joints
    assert joints["cart_fixed"].type == "fixed"
    assert (joints["left_slide"].lower, joints["left_slide"].upper) == (-0.2, 0.1)
    assert (joints["left_hinge"].type, joints["left_hinge"].upper) == ("revolute", 9.0)
    assert (joints["right_hinge"].type, joints["right_hinge"].upper) == ("continuous", np.inf)


def test_a_draft_says_what_is_left_to_do(folder):
    parts = yaml.safe_load((folder / "robot.yaml").read_text())
    assert parts["mirror"] == [-1, 1]
    assert parts["base"] == "foot"
    assert parts["arms"]["left"] == {
        "base": "foot", "joints": ["left_hinge", "left_slide"], "flange": "left_2", "hand": "left_2", "tcp": "left_tcp",
        "finger_joint": "left_g1", "fingers": ["left_f1", "left_f2"],
    }  # fmt: skip
    faults = folder_faults(folder)
    # that of the other finger is in the edits, and those of the right hand are measured
    assert any(fault.startswith("arms.left: finger 'left_f2' has no pad; give the link a box") for fault in faults)
    (effort,) = (f for f in faults if "effort" in f)
    assert effort == (
        "joints without a limit of effort > 0: left_slide (0), right_hinge (0), right_slide (0), right_g1 (0); give it"
        ' for all of them in <limit> of the URDF, or by `effort: {"*": NUMBER}` in --edits of a new draft'
    )
    assert len(faults) == 2


def broken(folder: Path, find: str, replace: str, file: str = "two.srdf") -> None:
    path = folder / file
    assert find in path.read_text()
    path.write_text(path.read_text().replace(find, replace))


def test_a_check_says_all_faults_at_once(folder):
    before = len(folder_faults(folder))
    broken(folder, 'velocity="2"', 'velocity="0"', "two.urdf")
    broken(folder, '<joint name="right_slide" value="0.05"/>', '<joint name="right_slide" value="0.5"/>')
    (folder / "meshes" / "visual" / "part.stl").rename(folder / "meshes" / "visual" / "gone.stl")
    faults = folder_faults(folder)
    assert any(
        f.startswith("joints without a limit of velocity > 0: left_hinge (0), right_hinge (0); ") for f in faults
    )
    assert sum("right_slide at 0.5, expected -0.1 .. 0.2" in f for f in faults) == 2  # of the arm, and of both
    assert sum("there is no mesh" in f for f in faults) == 2
    assert len(faults) == before + 5


def test_a_check_goes_on_without_the_files_that_are_missing(folder):
    (folder / "meshes" / "collision" / "part_hull.stl").unlink()
    (folder / "meshes" / "visual" / "part.stl").unlink()
    faults = folder_faults(folder)
    assert sum("there is no mesh" in f for f in faults) == 2  # each file once
    assert any(f.startswith("joints without a limit of effort > 0: left_slide (0), ") for f in faults)
    (folder / "two.srdf").unlink()
    assert f"there is no file {folder / 'two.srdf'}" in folder_faults(folder)


def test_a_check_names_links_that_touch_in_a_posture_or_always(folder):
    broken(folder, 'link1="right_f1" link2="right_f2"', 'link1="right_1" link2="right_f2"')
    broken(folder, '<origin xyz="-0.02 0 0.2"', '<origin xyz="0.02 0 0.2"', "two.urdf")
    faults = folder_faults(folder)
    words = "posture 'home'.*: right_f1 and right_f2 touch; give another one in semantics.yaml, "
    assert any(re.match(words, fault) for fault in faults)
    assert "right_f1 and right_f2 touch in every random state, and the SRDF does not allow it" in faults
    assert not any("left_f1 and left_f2" in f for f in faults)


def test_a_check_says_what_mujoco_says_of_a_urdf_that_it_cannot_read(folder):
    broken(folder, '<mass value="0.1"', '<mass value="0"', "two.urdf")
    assert any(f.startswith("MuJoCo does not read the URDF: ") for f in folder_faults(folder))
    broken(folder, 'velocity="2"', "", "two.urdf")
    assert any("velocity > 0: left_hinge (inf), right_hinge (inf); " in f for f in folder_faults(folder))
    assert any(f.startswith("pinocchio does not read the URDF: ") for f in folder_faults(folder))


@pytest.mark.parametrize("name", robot_names())
def test_nothing_is_wrong_with_the_robots_of_the_suite(name):
    assert folder_faults(load_folder(name)[0]) == []


def test_a_draft_of_a_urdf_brings_its_meshes_and_names_its_shapes(folder, tmp_path):
    text = (folder / "two.urdf").read_text().replace(' name="foot_block_collision"', "")
    (folder / "two.urdf").write_text(text)
    (tmp_path / "more").mkdir()
    draft_folder(tmp_path / "more" / "again", folder / "two.urdf", {"left": ("foot", "left_tcp")}, samples=100)
    again = RobotDescription.from_files(tmp_path / "more" / "again" / "again.urdf")
    assert [s.name for s in again.links["foot"].collision] == ["foot_00_collision"]
    assert f"{tmp_path}/more/again/meshes/collision/part_hull.stl" in again.urdf
    assert yaml.safe_load((tmp_path / "more" / "again" / "robot.yaml").read_text())["mirror"] == []


@pytest.mark.parametrize(
    ("arms", "words"),
    [
        ({}, "at least one arm"),
        ({"a": ("foot", "nowhere")}, "no link 'nowhere'"),
        ({"a": ("left_tcp", "left_tcp")}, "no joint moves 'left_tcp' against 'left_tcp'"),
        ({"a": ("right_1", "left_tcp")}, "no joint moves 'left_tcp' against 'right_1'"),
    ],
)
def test_arms_that_are_none_are_refused(folder, tmp_path, arms, words):
    assert refused(words, draft_folder, tmp_path / "three", folder / "two.urdf", arms).code is Code.INVALID_ARGUMENT
    refused("has a robot", draft_folder, folder, folder / "two.urdf", ARMS)


def test_triangles_are_shared_by_weight_and_never_more_than_allowed():
    meshes: Mapping[str, tuple[int, int, float]] = {"a": (10_000, 2, 1.0), "b": (10_000, 1, 2.0), "c": (30, 1, 1.0)}
    found = _budgets(meshes, 8000)
    assert found["b"] == pytest.approx(2 * found["a"], abs=2)
    assert found["c"] == 30
    assert 7900 < 2 * found["a"] + found["b"] + found["c"] <= 8000
    assert _budgets(meshes, 50_000) == {"a": 10_000, "b": 10_000, "c": 30}


ROBOTS = {"openarm_v2": "pedestal/openarm_pedestal.xml", "openarm_v2_cell": "cell/cell.xml"}


@pytest.fixture(scope="module", params=list(ROBOTS))
def drafted(request: pytest.FixtureRequest) -> tuple[Path, mujoco.MjModel]:
    """Folder of a robot of the maker of OpenArm, and the maker's model of it."""
    folder = models_dir() / "robots" / request.param
    file = mesh_file(f"package://openarm_mujoco/v2/{ROBOTS[request.param]}", folder / f"{request.param}.urdf")
    return folder, compiled(file)


@pytest.mark.long
@pytest.mark.requirement("B-07", "R-04")
def test_openarm_v2_moves_as_its_maker_s_model(drafted):
    folder, maker = drafted
    assert_same_motion(maker, RobotDescription.load(folder.name).urdf)


def test_the_urdf_of_openarm_v2_is_drafted_from_its_maker_s_model(drafted):
    """That of the Cell with the mesh files of openarm_v2, of which it has no copy."""
    folder, maker = drafted
    edits = Edits.model_validate(yaml.safe_load((folder / "edits.yaml").read_text()))
    shared = folder.parent / edits.meshes if edits.meshes else None
    draft = UrdfDraft(folder.name, maker, edits, shared)
    head, rest = draft.text().split("\n", 1)
    text = (folder / f"{folder.name}.urdf").read_text()
    assert text.startswith(head)
    assert text.endswith(rest)
    assert (folder / "meshes").exists() == (shared is None)


def test_a_robot_whose_meshes_are_wanted_must_be_there(tmp_path):
    edits = tmp_path / "edits.yaml"
    edits.write_text("meshes: openarm_v9")
    source = models_dir() / "boards" / "circles_4x11.xml"
    with pytest.raises(OpenArmError, match=r"edits.yaml:meshes: there is no robot 'openarm_v9' next to"):
        draft_folder(tmp_path / "mine", source, ARMS, edits)
