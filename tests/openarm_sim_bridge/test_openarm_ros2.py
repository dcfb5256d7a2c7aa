# SPDX-License-Identifier: Apache-2.0
"""The controllers of openarm_ros2: points are taken as they are, and nothing lies between them."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_control.follower import End
from openarm_control.trajectory import Trajectory
from openarm_sim_bridge.openarm_ros2 import OpenArmRos2, PositionController, activate
from openarm_sim_bridge.robot import SimulatedRobot
from openarm_sim_bridge.world.hardware import HardwareConfig
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.stage import Stage

SIDES = RobotDescription.load().arm_names

ELBOW = "openarm_right_joint4"
Ends = list[tuple[End, str]]


def _note(ends: Ends, end: End, text: str) -> None:
    ends.append((end, text))


@pytest.fixture
def controller() -> PositionController:
    return PositionController(("a", "b"), np.array([0.1, 0.2]))


def follow(controller: PositionController, t: list[float], q: list[list[float]]) -> Ends:
    ends: Ends = []
    goal = Trajectory(("a", "b"), np.array(t), np.array(q))
    controller.start(goal, 0, partial(_note, ends))
    return ends


def at(controller: PositionController, t: float) -> list[float]:
    return controller.update(round(t * 1e9), np.array([0.0, 0.0]), np.zeros(2)).tolist()


@pytest.mark.requirement("R-03")
def test_between_two_points_the_later_one_is_commanded(controller: PositionController) -> None:
    at(controller, 0.0)
    ends = follow(controller, [0.1, 0.5, 1.0], [[1.0, 1.0], [2.0, 2.0], [3.0, 3.0]])
    taken = {0.0: 0.0, 0.099: 0.0, 0.1: 2.0, 0.3: 2.0, 0.499: 2.0, 0.5: 3.0, 0.999: 3.0}
    assert {t: at(controller, t)[0] for t in taken} == taken
    assert ends == []
    assert at(controller, 1.0) == [3.0, 3.0]
    assert [end for end, _ in ends] == [End.SUCCEEDED]  # though the joints have not moved at all
    assert at(controller, 9.0) == [3.0, 3.0]


def test_a_newer_trajectory_takes_the_place_and_a_cancel_holds_where_the_joints_are(
    controller: PositionController,
) -> None:
    first = follow(controller, [1.0], [[1.0, 1.0]])
    second = follow(controller, [0.0], [[0.5, 0.5]])
    assert [end for end, _ in first] == [End.CANCELLED]
    assert at(controller, 0.0) == [0.5, 0.5]
    assert [end for end, _ in second] == [End.SUCCEEDED]
    third = follow(controller, [1.0], [[1.0, 1.0]])
    controller.cancel()
    assert [end for end, _ in third] == [End.CANCELLED]
    assert at(controller, 2.0) == [0.0, 0.0]


@pytest.fixture(scope="module")
def robot() -> SimulatedRobot:
    """Arms as owners have them, after activation."""
    description = RobotDescription.load()
    world = Stage(description, {}, None, PhysicsConfig(), HardwareConfig()).world(load_scene("empty"), each_step=True)
    world.reset({f"openarm_{side}_joint{i}": 0.0 for side in SIDES for i in range(1, 8)} | {ELBOW: 0.4})
    activate(world)
    return SimulatedRobot(description, world, OpenArmRos2(description, world.joint_names, world.read_joints()))


@pytest.mark.requirement("R-03")
def test_activation_drives_all_joints_to_zero(robot: SimulatedRobot) -> None:
    assert np.abs(robot.world.read_joints().position).max() < 0.15  # they hang


@pytest.mark.long
@pytest.mark.requirement("R-03")
def test_a_sparse_trajectory_is_a_step_and_a_dense_one_a_motion(robot: SimulatedRobot) -> None:
    """The same motion of 0.4 rad in 2 s, by two points and by one for each 10 ms."""
    controllers = robot.controller
    assert isinstance(controllers, OpenArmRos2)
    right = controllers.controllers["right_joint_trajectory_controller"]
    speeds: list[float] = []
    for n in (2, 201):
        start, t = right.command.copy(), np.linspace(0.0, 2.0, n)
        u = (t / 2.0)[:, None]
        goal = start + 0.4 * np.array([0, 0, 0, 1.0, 0, 0, 0]) * (3 * u**2 - 2 * u**3)
        ends: Ends = []
        right.start(Trajectory(right.group.names, t, goal), robot.world.t_ns, partial(_note, ends))
        fastest = 0.0
        while not ends:
            robot.tick()
            fastest = max(fastest, float(np.abs(right.velocity).max()))
        for _ in range(500):
            robot.tick()
            fastest = max(fastest, float(np.abs(right.velocity).max()))
        speeds.append(fastest)
    assert speeds[0] > 3.0 * speeds[1]
    assert speeds[1] < 0.6


def test_nothing_is_said_of_the_fingers_but_where_they_are(robot: SimulatedRobot) -> None:
    controllers, state = robot.controller, robot.world.read_joints()
    assert isinstance(controllers, OpenArmRos2)
    fingers = [i for i, name in enumerate(robot.world.joint_names) if "finger" in name]
    state.velocity[fingers], state.effort[fingers] = 0.01, 5.0
    reported = controllers.reported(state)
    np.testing.assert_array_equal(reported.velocity[fingers], 0.0)
    np.testing.assert_array_equal(reported.effort[fingers], 0.0)
    np.testing.assert_array_equal(reported.position, state.position)
