# SPDX-License-Identifier: Apache-2.0
"""Two arms in grasping, in the simulated world of this process, judged by its truth."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Table, random_scene
from openarm_evaluation.campaign.gap import LEAST_GAP, Gap, least_gap, watch_gap
from openarm_evaluation.campaign.planner import arms_behind
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_evaluation.campaign.sets import make_task
from openarm_evaluation.campaign.traffic import Traffic
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_motion.timing.checks import Motion


def run(set_name: str, seed: int):
    trials = Trials(make_task(set_name, seed), SimulatedSenses(depth_noise=False), GraspConfig())
    return trials, trials.run()


@pytest.mark.requirement("P-12")
def test_an_object_changes_hands_in_the_middle_and_stands_where_one_arm_alone_cannot_put_it() -> None:
    trials, row = run("handover", 5000)
    assert row["as_expected"], row["message"]
    assert row["grasps"][0]["route"] == "hand_over"
    arms = [step.arm for step in trials.steps if step.state == "LIFT"]
    assert sorted(arms) == ["left", "right"]
    assert row["place_error_mm"] < 20.0


@pytest.mark.requirement("N-13", "A-65")
def test_an_object_that_no_arm_can_grasp_is_pushed_and_then_grasped() -> None:
    trials, row = run("push", 5000)
    assert row["as_expected"], row["message"]
    assert row["grasps"][0]["route"] == "push"
    told = [step.reason for step in trials.steps if step.reason.startswith("push 1 by the")]
    assert told
    # what the camera says of the push is what happened: the object was there when it was grasped
    assert float(told[0].split(" mm from where")[0].split()[-1]) < 20.0


@pytest.mark.requirement("A-65")
def test_two_objects_are_grasped_at_once_and_the_arms_keep_apart() -> None:
    trials, row = run("pairs", 5001)
    assert row["as_expected"], row["message"]
    assert row["arm_gap_mm"] >= 1e3 * LEAST_GAP
    assert {g["arm"] for g in row["grasps"]} == {"left", "right"}
    closed = {step.arm: step.t_ns for step in trials.steps if step.state == "CLOSE_GRIPPER"}
    placed = {step.arm: step.t_ns for step in trials.steps if step.state == "PLACE"}
    assert max(closed.values()) < min(placed.values())  # both hands closed before either had placed


def test_the_judge_of_the_gap_measures_what_mujoco_measures_pair_by_pair() -> None:
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False))
    gap = watch_gap(robot)
    model, data = robot.world.model, robot.world.data
    left, right = gap.sides
    pairs = [mujoco.mj_geomDistance(model, data, int(i), int(j), 2.0, None) for i in left for j in right]
    assert min(len(left), len(right)) > 8
    assert gap.distance(data) == pytest.approx(min(pairs), abs=1e-9)
    robot.pass_time(0.05)
    assert gap.least == pytest.approx(min(pairs), abs=0.01)


def test_the_gap_of_joint_states_is_that_of_the_simulation_which_they_come_from() -> None:
    robot, table = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False)), Table()
    home = robot.states.latest()[1]
    arms = arms_behind(table.top_z, table.centre, table.extents)

    def over(arm: str, y: float) -> dict[str, float]:
        target = np.eye(4)
        target[:3, :3] = np.diag([1.0, -1.0, -1.0])
        target[:3, 3] = (0.27, y, 0.60)
        start = np.array([home[joint] for joint in arms[arm].names])
        found = arms[arm].inverse.position_solutions(target, 0.05, start)[0].q
        return dict(zip(arms[arm].names, found.tolist(), strict=True))

    gap = Gap(robot.world.model)
    states: list[tuple[int, dict[str, float]]] = []
    distances: list[float] = []
    for k, y in enumerate((-0.20, -0.10, -0.15)):
        moved = over("left", 0.05) | over("right", y)
        robot.world.reset(moved)
        states.append((k * 10**9, home | moved))
        distances.append(gap.distance(robot.world.data))
    assert distances[1] < distances[2] < distances[0]
    assert least_gap(states) == pytest.approx(distances[1], abs=1e-9)


def test_an_arm_under_way_leaves_room_or_makes_the_other_rest() -> None:
    table = Table()
    arms = arms_behind(table.top_z, table.centre, table.extents)
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False))
    state = robot.states.latest()[1]
    traffic = Traffic(arms)
    target = np.eye(4)
    target[:3, :3] = np.diag([1.0, -1.0, -1.0])
    target[:3, 3] = (0.27, 0.0, 0.50)
    over: dict[str, Motion] = {}
    for name, arm in arms.items():
        start = np.array([state[joint] for joint in arm.names])
        there = arm.inverse.position_solutions(target, 0.05, start)[0].q
        over[name] = Motion(arm.names, np.array([0.0, 2.0, 4.0]), np.array([start, there, start]))
    assert traffic.room(arms["left"], over["left"], 0, state, {}, 20.0) == 0.0
    traffic.enter("left", over["left"], 0)
    rest = traffic.room(arms["right"], over["right"], 0, state, {}, 20.0)
    assert 0.5 < rest < 4.0  # it comes when the left arm is about to be gone
    with pytest.raises(OpenArmError, match="would have to wait longer") as error:
        traffic.room(arms["right"], over["right"], 0, state, {}, 0.2)
    assert error.value.code is Code.IN_COLLISION
    # The left arm stops in the middle: the right one, on its way there, must stop, too.
    traffic.enter("right", over["right"], 0)
    stopped = dict(state) | dict(zip(over["left"].names, over["left"].q[1].tolist(), strict=True))
    traffic.leave("left", 0, stopped, arrived=False)
    with pytest.raises(OpenArmError, match="left arm stopped on its way"):
        traffic.look_out("right", None)
