# SPDX-License-Identifier: Apache-2.0
"""Motors and masses of a robot as owners have it: what is drawn, and what arrives in the simulated world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from pydantic import ValidationError

from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_sim_bridge.faults.faults import checked_fault
from openarm_sim_bridge.faults.world_faults import WorldFaults
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig, drawn
from openarm_sim_bridge.world.model import PhysicsConfig, robot_spec
from openarm_sim_bridge.world.stage import Stage
from openarm_sim_bridge.world.world import World

SIDES = RobotDescription.load().arm_names

ARM = slice(8, 15)


def world_of(description: RobotDescription, hardware: HardwareConfig) -> tuple[Stage, World]:
    stage = Stage(description, {}, None, PhysicsConfig(), hardware)
    return stage, stage.world(load_scene("empty"))


def test_an_ideal_robot_is_as_described(description: RobotDescription) -> None:
    made = drawn(IDEAL, description)
    assert set(made.mass.values()) == set(made.gearbox.values()) == {1.0}
    assert set(made.zero.values()) == set(made.latency_s.values()) == {0.0}
    assert not made.friction
    encoders = made.encoders(description, Stage(description, {}, None, PhysicsConfig()).joint_names)
    assert not np.any([encoders.zero, encoders.position, encoders.velocity, encoders.effort, encoders.latency_s])


def test_what_is_drawn_arrives_in_the_model(description: RobotDescription) -> None:
    config = HardwareConfig(gain_error=0.3, mass_error=0.1).of(description)
    made = drawn(config, description)
    model = robot_spec(description, PhysicsConfig(), made).compile()
    nominal = robot_spec(description, PhysicsConfig()).compile()
    for side in SIDES:
        for i, name in enumerate(description.arm_joints(side)):
            actuator, dof = model.actuator(name), model.joint(name).dofadr[0]
            assert actuator.gainprm[0] / config.stiffness[i] in (pytest.approx(0.7), pytest.approx(1.3))
            assert 0.2 <= model.dof_frictionloss[dof] <= 0.5
            described = nominal.dof_damping[nominal.joint(name).dofadr[0]]
            assert model.dof_damping[dof] == pytest.approx(described * made.gearbox[name])
    link = "openarm_right_link2"
    share = model.body(link).mass[0] / nominal.body(link).mass[0]
    assert share in (pytest.approx(0.9), pytest.approx(1.1))
    np.testing.assert_allclose(model.body(link).inertia, share * nominal.body(link).inertia)
    assert model.body_gravcomp.max() < 1e-6


@pytest.mark.parametrize("name", ["openarm_v1", "openarm_v2", "panda", "ur5e"])
def test_fingers_of_a_seed_stop_within_a_few_millimetres_of_the_drawing_and_start_closed(name: str) -> None:
    robot = RobotDescription.load(name)
    ends: list[tuple[float, float]] = []
    for seed in range(20):
        for arm, stops in drawn(HardwareConfig(hand_seed=seed), robot).fingers.items():
            ends.append((stops.closed, stops.opened))
            assert 0.0 <= stops.closed <= 0.045 * robot.hand(arm).parts.opening
            assert 0.82 * robot.hand(arm).parts.opening <= stops.opened <= robot.hand(arm).parts.opening
    assert len(set(ends)) == len(ends)
    assert not drawn(HardwareConfig(), robot).fingers
    config = HardwareConfig(hand_seed=3)
    stops, model = drawn(config, robot).fingers, robot_spec(robot, PhysicsConfig(), drawn(config, robot)).compile()
    stage = Stage(robot, {}, None, PhysicsConfig(), config)
    for arm, hand in robot.hands.items():
        positions = sorted(hand.position(finger) for finger in (stops[arm].closed, stops[arm].opened))
        np.testing.assert_allclose(model.joint(hand.joint).range, positions, atol=1e-9)
        assert hand.finger(stage.home[hand.joint]) == pytest.approx(stops[arm].closed)


def test_a_seed_is_a_robot_and_another_seed_another(description: RobotDescription) -> None:
    one, again, other = (drawn(HardwareConfig().of_seed(seed), description) for seed in (4, 4, 5))
    assert (one.friction, one.zero, one.mass, one.latency_s) == (
        again.friction,
        again.zero,
        again.mass,
        again.latency_s,
    )
    assert one.friction != other.friction
    assert one.zero != other.zero
    zeros = [z for seed in range(60) for z in drawn(HardwareConfig().of_seed(seed), description).zero.values()]
    assert np.degrees(np.std(zeros)) == pytest.approx(0.1, rel=0.1)


def test_positions_are_in_steps_of_sixteen_bits_and_off_by_the_zeros(description: RobotDescription) -> None:
    stage, world = world_of(description, HardwareConfig(zero_rms=1.0))
    home = np.array([stage.home[name] for name in stage.joint_names])[ARM]
    read, step = world.read_joints().position[ARM], 25.0 / 65535.0
    np.testing.assert_allclose(read / step, np.round(read / step), atol=1e-6)
    np.testing.assert_allclose(read - home, stage.encoders.zero[ARM], atol=0.5 * step + 1e-9)
    assert np.abs(stage.encoders.zero[ARM]).max() > np.radians(0.5)


@pytest.mark.parametrize(("latency", "steps"), [(0.0, 0), (0.004, 2), (0.026, 13)])
def test_a_command_takes_effect_when_its_latency_is_over(
    description: RobotDescription, latency: float, steps: int
) -> None:
    stage, world = world_of(description, IDEAL.model_copy(update={"latency": (latency, latency)}))
    start = np.array([stage.home[name] for name in stage.joint_names])
    world.set_targets(start + 0.1)
    begun = -1
    for step in range(20):
        world.step(1)
        if (
            begun < 0
            and np.abs(world.data.ctrl - start[0]).max()
            and np.abs(world.read_joints().velocity[ARM]).max() > 0.1
        ):
            begun = step
    assert begun == steps


def test_later_commands_do_not_overtake(description: RobotDescription) -> None:
    stage, world = world_of(description, IDEAL.model_copy(update={"latency": (0.026, 0.026)}))
    start = np.array([stage.home[name] for name in stage.joint_names])
    seen: list[float] = []
    for k in range(8):
        world.set_targets(start + 0.01 * k)
        world.step(world.steps_per_tick)
        seen.append(float(np.max(world.data.ctrl)))
    assert seen == sorted(seen)
    world.reset()
    world.step(20)
    np.testing.assert_allclose(np.sort(world.data.ctrl), np.sort(start))  # what was on its way is forgotten


def test_gains_for_other_arms_are_refused(description: RobotDescription) -> None:
    with pytest.raises(OpenArmError, match=r"stiffness has 6 numbers, arm 'left' has 7 joints"):
        drawn(HardwareConfig(stiffness=(1.0,) * 6), description)
    with pytest.raises(OpenArmError, match="lacks `motors`"):
        drawn(HardwareConfig(), replace(description, motors=None))


@pytest.mark.parametrize("wrong", [{"stiffness": (-1.0,) * 7}, {"friction": (0.5, 0.2)}, {"latency": (-1.0, 0.0)}])
def test_an_impossible_robot_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        HardwareConfig.model_validate(wrong)


@pytest.mark.parametrize(("side", "late"), [(SIDES[0], [True, False]), ("both", [True, True])])
def test_commands_are_late_for_the_side_that_is_named(
    description: RobotDescription, side: str, late: list[bool]
) -> None:
    stage, world = world_of(description, IDEAL)
    faults = WorldFaults(description, world.joint_names)
    faults.inject(checked_fault("joint_late", {"ms": 100.0, "side": side}), world)
    faults.prepare(world)
    before = world.read_joints().position
    world.set_targets(np.array([stage.home[name] for name in stage.joint_names]) + 0.1)
    world.step(20)
    moved = dict(zip(world.joint_names, np.abs(world.read_joints().position - before), strict=True))
    assert [max(moved[name] for name in description.arm_joints(arm)) < 1e-3 for arm in SIDES] == late
