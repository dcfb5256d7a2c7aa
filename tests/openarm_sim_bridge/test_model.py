# SPDX-License-Identifier: Apache-2.0
"""The compiled world: what the importer must keep, what is added, and that it stands still where it should."""

from __future__ import annotations

import io
import time

import mujoco
import numpy as np
import pytest
import yourdfpy
from pydantic import ValidationError

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras, true_mount
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene, load_scene
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig, drawn
from openarm_sim_bridge.world.model import PhysicsConfig, build_spec, compile_model, robot_spec

SIDES = RobotDescription.load().arm_names

GEOM, BODY = mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_BODY


@pytest.fixture(scope="module")
def cameras() -> dict[str, CameraConfig]:
    return load_cameras()


@pytest.fixture(scope="module")
def demo() -> Scene:
    return load_scene("demo")


@pytest.fixture(scope="module")
def model(description: RobotDescription, demo: Scene, cameras: dict[str, CameraConfig]) -> mujoco.MjModel:
    return compile_model(description, demo, cameras)


def put(model: mujoco.MjModel, description: RobotDescription, q: dict[str, float]) -> mujoco.MjData:
    """Data with joints at `q`, fingers coupled, targets where the joints are."""
    data = mujoco.MjData(model)
    for name, joint in description.joints.items():
        if (joint.mimic or name) in q:
            data.qpos[model.joint(name).qposadr[0]] = q[joint.mimic or name]
    for i in range(model.nu):
        data.ctrl[i] = data.qpos[model.jnt_qposadr[model.actuator_trnid[i, 0]]]
    mujoco.mj_forward(model, data)
    return data


def home(description: RobotDescription) -> dict[str, float]:
    return description.group_state("both_arms", "home") | {description.finger_joint(side): 0.0 for side in SIDES}


def body_of(model: mujoco.MjModel, geom: int) -> str:
    return model.body(model.geom_bodyid[geom]).name


def test_every_link_is_a_body_and_every_actuator_is_named_like_its_joint(
    description: RobotDescription, model: mujoco.MjModel
) -> None:
    bodies = {model.body(i).name for i in range(model.nbody)}
    assert set(description.links) <= bodies
    actuated = {name for side in SIDES for name in (*description.arm_joints(side), description.finger_joint(side))}
    assert {model.actuator(i).name for i in range(model.nu)} == actuated
    for name in actuated:
        assert model.actuator(name).trnid[0] == model.joint(name).id


@pytest.mark.requirement("A-13")
def test_collision_shapes_are_boxes_and_cylinders_and_not_drawn(
    description: RobotDescription, model: mujoco.MjModel
) -> None:
    simple = {mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_PLANE}
    assert model.nmesh == 0
    assert {int(kind) for kind in model.geom_type} <= simple
    for link in description.links.values():
        for shape in link.visual:
            geom = model.geom(shape.name)
            assert (geom.contype[0], geom.conaffinity[0], geom.group[0]) == (0, 0, 2)
        for shape in link.collision:
            geom = model.geom(shape.name)
            assert (geom.contype[0], geom.conaffinity[0], geom.group[0]) == (1, 1, 3)


@pytest.mark.long
@pytest.mark.requirement("A-13")
def test_a_step_is_cheap(description: RobotDescription, model: mujoco.MjModel) -> None:
    data = put(model, description, home(description))
    mujoco.mj_step(model, data, 200)
    best = np.inf
    for _ in range(5):
        start = time.process_time()
        mujoco.mj_step(model, data, 200)
        best = min(best, (time.process_time() - start) / 200)
    assert best < 300e-6, f"{best * 1e6:.0f} us a step; 2 ms of simulated time"


def test_masses_are_those_of_the_description_and_the_scene(
    description: RobotDescription, demo: Scene, model: mujoco.MjModel
) -> None:
    for name, link in yourdfpy.URDF.load(io.StringIO(description.urdf), load_meshes=False).link_map.items():
        mass = link.inertial.mass if link.inertial else 0.0
        assert model.body(name).mass[0] == pytest.approx(mass, rel=1e-9), name
    for item in demo.objects:
        assert model.body(item.name).mass[0] == pytest.approx(item.mass_kg)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("q", [0.0, 0.011, 0.025, 0.044])
def test_the_gap_of_the_jaw_is_twice_the_finger_position(
    description: RobotDescription, model: mujoco.MjModel, side: str, q: float
) -> None:
    data = put(model, description, home(description) | {f"openarm_{side}_finger_joint1": q})
    opening = data.body(f"openarm_{side}_hand").xmat.reshape(3, 3)[:, 1]
    inner = []
    for finger, outward in (("left", 1.0), ("right", -1.0)):
        name = f"openarm_{side}_{finger}_finger_pad_collision"
        inner.append(data.geom(name).xpos @ opening - outward * model.geom(name).size[1])
    assert inner[0] - inner[1] == pytest.approx(2 * q, abs=1e-9)
    tcp = data.site(f"openarm_{side}_hand_tcp").xpos @ opening
    assert (inner[0] + inner[1]) / 2 == pytest.approx(tcp, abs=1e-9)


def test_only_the_pads_have_priority_and_they_decide_the_friction(
    model: mujoco.MjModel, description: RobotDescription
) -> None:
    physics = PhysicsConfig()
    names = {model.geom(i).name for i in range(model.ngeom) if model.geom_priority[i] > 0}
    fingers = ("left_finger", "right_finger")
    assert names == {f"openarm_{side}_{finger}_pad_collision" for side in SIDES for finger in fingers}
    for name in names:
        assert tuple(model.geom(name).friction) == physics.pad_friction
        assert model.geom(name).condim[0] == 4


def test_the_fingers_are_coupled_stiffly(description: RobotDescription, model: mujoco.MjModel) -> None:
    assert model.neq == 2
    data = put(model, description, home(description))
    finger = description.finger_joint("right")
    data.ctrl[model.actuator(finger).id] = 0.04
    for _ in range(500):
        mujoco.mj_step(model, data)
    lead, follow = (data.qpos[model.joint(f"openarm_right_finger_joint{i}").qposadr[0]] for i in (1, 2))
    assert lead == pytest.approx(0.04, abs=2e-4)
    assert follow == pytest.approx(lead, abs=2e-4)


def test_no_contact_is_computed_for_the_pairs_of_the_srdf(description: RobotDescription, model: mujoco.MjModel) -> None:
    excluded = {
        frozenset((model.body(int(s) >> 16).name, model.body(int(s) & 0xFFFF).name)) for s in model.exclude_signature
    }
    assert excluded == set(description.allowed_collisions)


@pytest.mark.parametrize("state", ["home", "hands_up", "zero"])
@pytest.mark.requirement("A-74")
def test_named_postures_touch_nothing(description: RobotDescription, model: mujoco.MjModel, state: str) -> None:
    data = put(model, description, home(description) | description.group_state("both_arms", state))
    touching = {
        tuple(sorted((body_of(model, c.geom1), body_of(model, c.geom2))))
        for c in data.contact
        if any(body_of(model, g).startswith("openarm") for g in (c.geom1, c.geom2))
    }
    assert not touching


@pytest.mark.requirement("A-74")
def test_arms_crossed_in_front_of_the_chest_are_a_contact(description: RobotDescription, model: mujoco.MjModel) -> None:
    q = home(description) | description.group_state("both_arms", "official_home")
    q |= {"openarm_left_joint3": 0.6, "openarm_right_joint3": -0.6}
    q |= {"openarm_left_joint1": -0.3, "openarm_right_joint1": 0.3}
    data = put(model, description, q)
    touching = [(body_of(model, c.geom1), body_of(model, c.geom2)) for c in data.contact]
    assert any({a[:12], b[:12]} == {"openarm_left", "openarm_righ"} for a, b in touching), touching


def test_gravity_is_carried_and_without_compensation_the_arm_sags(
    description: RobotDescription, demo: Scene, cameras: dict[str, CameraConfig], model: mujoco.MjModel
) -> None:
    def drop(compiled: mujoco.MjModel) -> float:
        data = put(compiled, description, home(description))
        tcp = compiled.site("openarm_right_hand_tcp").id
        start = data.site_xpos[tcp].copy()
        mujoco.mj_step(compiled, data, 500)
        return float(np.linalg.norm(data.site_xpos[tcp] - start))

    assert drop(model) < 2e-4
    heavy = robot_spec(description, PhysicsConfig(), drawn(HardwareConfig(), description))
    assert drop(build_spec(description, demo, cameras, robot=heavy).compile()) > 3e-2


def test_objects_rest_where_the_scene_puts_them(
    description: RobotDescription, demo: Scene, model: mujoco.MjModel
) -> None:
    data = put(model, description, home(description))
    mujoco.mj_step(model, data, 1000)
    for item in demo.objects:
        T = item.T_world_object(demo.table)
        np.testing.assert_allclose(data.body(item.name).xpos, T[:3, 3], atol=5e-4, err_msg=item.name)
        np.testing.assert_allclose(data.body(item.name).xmat.reshape(3, 3), T[:3, :3], atol=5e-3)
        assert np.linalg.norm(data.body(item.name).cvel) < 1e-3


@pytest.mark.requirement("A-27")
def test_cameras_see_60_degrees(model: mujoco.MjModel, cameras: dict[str, CameraConfig]) -> None:
    assert {model.camera(i).name for i in range(model.ncam)} == set(cameras)
    for name in ("overhead", "wrist"):
        assert model.camera(name).fovy[0] == 60.0
        assert tuple(model.cam_resolution[model.camera(name).id]) == (640, 480)
    assert (model.vis.global_.offwidth, model.vis.global_.offheight) == (640, 480)
    assert model.vis.quality.offsamples == 0


@pytest.mark.parametrize("seed", [None, 1, 2])
@pytest.mark.requirement("P-27")
def test_cameras_stand_where_the_mount_seed_puts_them(
    description: RobotDescription, demo: Scene, cameras: dict[str, CameraConfig], seed: int | None
) -> None:
    compiled = compile_model(description, demo, cameras, seed)
    data = put(compiled, description, home(description))
    poses = description.link_poses(home(description))
    for name, camera in cameras.items():
        T_parent_optical = true_mount(camera, seed) @ se3.inverse(camera.T_parent_link) @ camera.T_parent_optical
        T = poses[camera.parent] @ T_parent_optical
        seen = data.camera(name)
        np.testing.assert_allclose(seen.xpos, T[:3, 3], atol=1e-9)
        # MuJoCo: x right, y up, looks along -z; optical: x right, y down, z forward.
        np.testing.assert_allclose(seen.xmat.reshape(3, 3), T[:3, :3] @ np.diag([1.0, -1.0, -1.0]), atol=1e-9)
        off = float(np.linalg.norm(true_mount(camera, seed)[:3, 3] - camera.T_parent_link[:3, 3]))
        assert (off > 1e-3) == (seed is not None and camera.mount_error)
        assert off <= 0.0151


def test_physics_settings_arrive_in_the_model(description: RobotDescription) -> None:
    physics = PhysicsConfig(timestep=0.001, impratio=3.0, cone="pyramidal", integrator="euler", noslip_iterations=0)
    option = robot_spec(description, physics).compile().opt
    assert (option.timestep, option.impratio, option.noslip_iterations) == (0.001, 3.0, 0)
    assert option.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL
    assert option.integrator == mujoco.mjtIntegrator.mjINT_EULER
    default = robot_spec(description, PhysicsConfig()).compile()
    dynamics = {
        name: joint.dynamics
        for name, joint in yourdfpy.URDF.load(io.StringIO(description.urdf), load_meshes=False).joint_map.items()
    }
    assert (default.opt.timestep, default.opt.impratio, default.opt.noslip_iterations) == (0.002, 10.0, 4)
    ideal = IDEAL.of(description)
    for side in SIDES:
        for i, name in enumerate(description.arm_joints(side)):
            actuator, joint = default.actuator(name), default.joint(name)
            assert actuator.gainprm[0] == ideal.stiffness[i]
            assert actuator.biasprm[2] == -ideal.damping[i]
            assert default.dof_damping[joint.dofadr[0]] == float(dynamics[name].damping)
            assert default.dof_frictionloss[joint.dofadr[0]] == float(dynamics[name].friction)
            assert default.dof_armature[joint.dofadr[0]] == ideal.armature[i]


@pytest.mark.parametrize("wrong", [{"timestep": 0.0}, {"cone": "round"}, {"stiffness": 1.0}])
def test_impossible_physics_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        PhysicsConfig.model_validate(wrong)


def test_a_camera_on_a_link_that_is_not_there_is_refused(description: RobotDescription, demo: Scene) -> None:
    camera = CameraConfig(
        name="tail", parent="openarm_tail", position=(0, 0, 0), forward=(1, 0, 0), image_right=(0, -1, 0)
    )
    with pytest.raises(OpenArmError, match=r"camera 'tail': no link 'openarm_tail'.*openarm_right_link7") as caught:
        build_spec(description, demo, {"tail": camera})
    assert caught.value.code is Code.CONFIG_INVALID
