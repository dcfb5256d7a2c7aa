# SPDX-License-Identifier: Apache-2.0
"""Force sensors: contact forces with either order of the geoms, and the weight that a wrist carries."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from openarm_common.camera.cameras import load_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.touch import add_wrist_sensor, contact_wrench, hand_link, pad_links, wrist_wrench

WEIGHT = 0.5 * 9.81
BOX = (
    '<body name="box" pos="0.02 0 0.049"><freejoint/><geom name="box" type="box" size=".05 .05 .05" mass=".5"/></body>'
)
PAD = '<body name="pad" pos="0 0 -0.05"><geom name="pad" type="box" size=".1 .1 .05"/></body>'


@pytest.mark.parametrize("bodies", [BOX + PAD, PAD + BOX], ids=["pad second", "pad first"])
@pytest.mark.requirement("A-69")
def test_contact_force_has_its_sign_in_both_orders_of_the_geoms(bodies: str) -> None:
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    pad, box = (model.geom(name).id for name in ("pad", "box"))
    assert {(int(c.geom1), int(c.geom2)) for c in data.contact} == {(min(pad, box), max(pad, box))}
    force, torque = contact_wrench(model, data, pad)
    np.testing.assert_allclose(force, [0.0, 0.0, -WEIGHT], atol=0.01)
    # The weight acts 2 cm along x from the pad's origin; the contact lies 5 cm above it.
    np.testing.assert_allclose(torque, [0.0, 0.02 * WEIGHT, 0.0], atol=0.003)
    up, _ = contact_wrench(model, data, box)
    np.testing.assert_allclose(up, -force, atol=1e-6)


@pytest.mark.requirement("A-69")
def test_the_force_is_given_in_the_frame_of_the_body() -> None:
    turned = PAD.replace('name="pad" pos', 'name="pad" euler="180 0 0" pos', 1)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{BOX}{turned}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=1000)
    force, _ = contact_wrench(model, data, model.geom("pad").id)
    np.testing.assert_allclose(force, [0.0, 0.0, WEIGHT], atol=0.01)


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
    add_wrist_sensor(spec, "hand")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, nstep=10)
    force, torque = wrist_wrench(data, "hand")
    np.testing.assert_allclose(force, [0.0, 0.0, WEIGHT], atol=1e-6)  # what holds it: the arm pushes up
    np.testing.assert_allclose(torque, [0.0, -0.1 * WEIGHT, 0.0], atol=1e-6)


@pytest.mark.requirement("A-24")
def test_the_robot_has_the_sensors() -> None:
    stage = Stage(RobotDescription.load(), load_cameras(), None, PhysicsConfig())
    world = stage.world(load_scene("empty"))
    for _ in range(30):
        world.step(world.steps_per_tick)
    for side in ("left", "right"):
        model, body = world.model, world.model.body(hand_link(side))
        force, _ = world.wrist_wrench(hand_link(side))
        assert np.linalg.norm(force) == pytest.approx(9.81 * model.body_subtreemass[body.id], rel=0.02)
        for link in pad_links(side):
            assert not world.pad_wrench(link)[0].any()
