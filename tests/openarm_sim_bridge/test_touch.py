# SPDX-License-Identifier: Apache-2.0
"""Sensors: contact forces with either order of the geoms, the weight that a wrist carries, the IMU of a hand."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.verdicts import Evidence, judge_grip
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.touch import add_hand_sensors, contact_wrench, imu, wrist_wrench

WEIGHT = 0.5 * 9.81
BOX = (
    '<body name="box" pos="0.02 0 0.049"><freejoint/><geom name="box" type="box" size=".05 .05 .05" mass=".5"/></body>'
)
PAD = '<body name="pad" pos="0 0 -0.05"><geom name="pad" type="box" size=".1 .1 .05"/></body>'


SLOPE = 20.0


@pytest.mark.parametrize("slope", [0.0, SLOPE])
@pytest.mark.parametrize("pad_is_second", [True, False], ids=["pad second", "pad first"])
@pytest.mark.requirement("A-69")
def test_a_contact_is_found_in_either_order_and_its_force_is_that_along_the_normal(
    *, pad_is_second: bool, slope: float
) -> None:
    """A box of known weight rests on a pad, level or tilted; another one stands elsewhere and does not count."""
    pad_body = PAD.replace('name="pad" pos', f'name="pad" euler="0 {slope} 0" pos', 1)
    box_body = BOX.replace('pos="0.02 0 0.049"', f'euler="0 {slope} 0" pos="{above(slope)}"')
    beside = (
        '<geom type="plane" size="2 2 .1" pos="0 0 -1"/><body pos="1 0 -.951"><freejoint/><geom size=".05"/></body>'
    )
    bodies = (box_body, pad_body) if pad_is_second else (pad_body, box_body)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{''.join(bodies)}{beside}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    pad, box = (model.geom(name).id for name in ("pad", "box"))
    between = [i for i, c in enumerate(data.contact) if {int(c.geom1), int(c.geom2)} == {pad, box}]
    assert len(between) >= 3
    assert data.ncon > len(between)
    assert {int(data.contact[i].geom2) == pad for i in between} == {pad_is_second}

    # the physics' own answer: what is along the normal carries the part of the weight that is across the surface
    results = np.zeros((len(between), 6))
    for i, result in zip(between, results, strict=True):
        mujoco.mj_contactForce(model, data, i, result)
    across, along = WEIGHT * np.cos(np.radians(slope)), WEIGHT * np.sin(np.radians(slope))
    assert results[:, 0].min() > 0.0
    assert results[:, 0].sum() == pytest.approx(across, abs=0.02)
    assert np.linalg.norm(results[:, 1:3].sum(axis=0)) == pytest.approx(along, abs=0.02)
    normal = data.contact[between[0]].frame[:3]
    up = [np.sin(np.radians(slope)), 0.0, np.cos(np.radians(slope))]
    np.testing.assert_allclose(normal, up if not pad_is_second else np.negative(up), atol=1e-3)

    # in the frame of the pad, z across its surface
    force, torque = contact_wrench(model, data, pad)
    np.testing.assert_allclose(force, [along, 0.0, -across], atol=0.02)
    if not slope:  # the weight acts 2 cm along x from the pad's origin; the contact lies 5 cm above it
        np.testing.assert_allclose(torque, [0.0, 0.02 * WEIGHT, 0.0], atol=0.003)
    on_box, _ = contact_wrench(model, data, box)
    T = (data.geom_xmat[g].reshape(3, 3) for g in (pad, box))
    np.testing.assert_allclose(next(T) @ force, -(next(T) @ on_box), atol=1e-6)


def above(slope: float) -> str:
    """Position of a box on a pad that is tilted about its middle, 2 cm along x."""
    c, s = np.cos(np.radians(slope)), np.sin(np.radians(slope))
    return f"{0.02 * c + 0.099 * s} 0 {-0.05 + 0.099 * c - 0.02 * s}"


@pytest.mark.parametrize(("grams", "held"), [(40, False), (60, True)])
@pytest.mark.requirement("A-69")
def test_a_pad_feels_an_object_from_half_a_newton_on(grams: int, held: bool) -> None:
    box = BOX.replace('mass=".5"', f'mass="{grams / 1000}"')
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{PAD}{box}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    force = float(np.linalg.norm(contact_wrench(model, data, model.geom("pad").id)[0]))
    assert force == pytest.approx(grams / 1000 * 9.81, abs=0.01)
    felt = Evidence(0.05, 0.05, -30.0, 0.0, pads=(5.0, force))  # the other pad feels it well
    verdict = judge_grip(felt, HeldConfig(use_finger_force=True))
    assert verdict.ok == held, verdict.reason


def test_nothing_touches_nothing() -> None:
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{PAD}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    force, torque = contact_wrench(model, data, model.geom("pad").id)
    assert not force.any()
    assert not torque.any()


@pytest.mark.requirement("P-26")
def test_a_wrist_feels_the_weight_beyond_it() -> None:
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body name="arm"><joint axis="0 0 1" damping="1"/><geom size=".05" mass="1"/>'
        '<body name="hand" pos=".3 0 0"><geom size=".02" pos=".1 0 0" mass=".5"/></body></body></worldbody></mujoco>'
    )
    add_hand_sensors(spec, "hand")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=10)
    force, torque = wrist_wrench(data, "hand")
    np.testing.assert_allclose(force, [0.0, 0.0, WEIGHT], atol=1e-6)  # what holds it: the arm pushes up
    np.testing.assert_allclose(torque, [0.0, -0.1 * WEIGHT, 0.0], atol=1e-6)


@pytest.mark.requirement("A-24")
def test_an_imu_shows_gravity_and_how_the_hand_turns() -> None:
    """A hand 0.3 m from an axis along y, turned about it at 2 rad/s: gravity and centripetal acceleration."""
    spec = mujoco.MjSpec.from_string(
        '<mujoco><option timestep=".001"/><worldbody><body name="arm"><joint name="turn" axis="0 1 0"/>'
        '<geom size=".05" mass="1"/><body name="hand" pos=".3 0 0"><geom size=".02" mass="1e-6"/></body></body>'
        "</worldbody></mujoco>"
    )
    add_hand_sensors(spec, "hand")
    model = spec.compile()
    data = mujoco.MjData(model)
    data.joint("turn").qpos[0], data.joint("turn").qvel[0] = 0.5, 2.0
    mujoco.mj_forward(model, data)
    rate, acceleration = imu(data, "hand")
    np.testing.assert_allclose(rate, [0.0, 2.0, 0.0], atol=1e-9)
    up = data.body("hand").xmat.reshape(3, 3).T @ [0.0, 0.0, 9.81]
    np.testing.assert_allclose(acceleration, up + np.array([-0.3 * 2.0**2, 0.0, 0.0]), atol=1e-3)


@pytest.mark.requirement("A-24")
def test_the_robot_has_the_sensors() -> None:
    description = RobotDescription.load()
    stage = Stage(description, load_cameras(), None, PhysicsConfig())
    world = stage.world(load_scene("empty"))
    for _ in range(30):
        world.step(world.steps_per_tick)
    for side in description.arm_names:
        model, body = world.model, world.model.body(description.arm(side).hand)
        force, _ = world.wrist_wrench(description.arm(side).hand)
        assert np.linalg.norm(force) == pytest.approx(9.81 * model.body_subtreemass[body.id], rel=0.02)
        rate, acceleration = world.imu(description.arm(side).hand)
        np.testing.assert_allclose(rate, np.zeros(3), atol=0.01)
        up = world.data.xmat[body.id].reshape(3, 3) @ acceleration
        np.testing.assert_allclose(up, [0.0, 0.0, 9.81], atol=0.05)
        for link in description.arm(side).fingers:
            assert not world.pad_wrench(link)[0].any()
