# SPDX-License-Identifier: Apache-2.0
"""Two arms in grasping, in the simulated world of this process, judged by its truth."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import random_scene
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses, arms_behind
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.trial import Trials
from openarm_evaluation.judging.arm_clearance import LEAST_CLEARANCE, ArmClearance, least_clearance, watch_clearance
from openarm_grasp.config import GraspConfig
from openarm_motion.service.requests import ExecuteRequest, MotionAnswer
from openarm_motion.timing.trajectory import Motion

ARMS = ("left", "right")


def judged(set_name: str, seed: int):
    trials = Trials(make_task(set_name, seed), SimulatedSenses(depth_noise=False), GraspConfig())
    return trials, trials.run()


@pytest.mark.requirement("P-12")
def test_an_object_changes_hands_in_the_middle_and_stands_where_one_arm_alone_cannot_put_it() -> None:
    trials, row = judged("handover", 5005)
    assert row["as_expected"], row["message"]
    assert row["grasps"][0]["route"] == "hand_over"
    assert sorted(step.arm for step in trials.steps if step.state == "LIFT") == ["left", "right"]
    assert row["place_error_mm"] < 20.0


@pytest.mark.requirement("N-13", "A-65")
def test_an_object_that_no_arm_can_grasp_is_pushed_and_then_grasped() -> None:
    trials, row = judged("push", 1)
    assert row["as_expected"], row["message"]
    assert row["grasps"][0]["route"] == "push"
    reasons = [step.reason for step in trials.steps if step.reason.startswith("push 1 by the")]
    assert reasons
    # what the camera says of the push is what happened: the object was there when it was grasped
    assert float(reasons[0].split(" mm from its destination")[0].split()[-1]) < 20.0


@pytest.mark.requirement("A-65")
def test_two_objects_are_grasped_at_once_and_the_arms_keep_apart() -> None:
    trials, row = judged("pairs", 5001)
    assert row["as_expected"], row["message"]
    assert row["arm_clearance_mm"] >= 1e3 * LEAST_CLEARANCE
    assert {g["arm"] for g in row["grasps"]} == {"left", "right"}
    arms, steps = ("left", "right"), trials.steps
    closed, placed = (
        [next(step.t_ns for step in steps if (step.arm, step.state) == (arm, state)) for arm in arms]
        for state in ("CLOSE_GRIPPER", "PLACE")
    )
    assert max(closed) < min(placed)  # both hands closed before either had placed; one may have to close again


@pytest.mark.long
@pytest.mark.requirement("A-65", "R-17")
def test_an_arm_of_an_order_takes_the_next_object_while_the_other_is_at_work() -> None:
    _, row = judged("orders", 613)
    assert row["as_expected"], row["message"]
    assert (len(row["grasps"]), all(g["placed"] for g in row["grasps"])) == (6, True)
    assert row["arm_clearance_mm"] >= 1e3 * LEAST_CLEARANCE
    spans = {arm: [(g["began_s"], g["began_s"] + g["sim_s"]) for g in row["grasps"] if g["arm"] == arm] for arm in ARMS}
    for mine, theirs in (ARMS, ARMS[::-1]):
        begun = [
            begin for begin, _ in spans[mine] if any(low + 0.1 < begin < high - 0.1 for low, high in spans[theirs])
        ]
        assert begun, spans


def test_the_judge_of_the_gap_measures_what_mujoco_measures_pair_by_pair() -> None:
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False))
    gap = watch_clearance(robot)
    model, data = robot.world.model, robot.world.data
    left, right = gap.arms
    pairs = [mujoco.mj_geomDistance(model, data, int(i), int(j), 2.0, None) for i in left for j in right]
    assert min(len(left), len(right)) > 8
    assert gap.distance(data) == pytest.approx(min(pairs), abs=1e-9)
    robot.pass_time(0.05)
    assert gap.least == pytest.approx(min(pairs), abs=0.01)


def test_arms_are_no_nearer_than_the_spheres_about_their_shapes(monkeypatch: pytest.MonkeyPatch) -> None:
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False))
    gap = ArmClearance(robot.description, robot.world.model)
    true = gap.distance(robot.world.data)
    monkeypatch.setattr(mujoco, "mj_geomDistance", lambda *_: 0.0)
    assert 0.05 < gap.distance(robot.world.data) <= true


def test_the_gap_of_joint_states_is_that_of_the_simulation_which_they_come_from() -> None:
    robot, table = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False)), robot_work().table
    home = robot.states.latest()[1]
    arms = arms_behind((), table)

    def over(arm: str, y: float) -> dict[str, float]:
        target = np.eye(4)
        target[:3, :3] = np.diag([1.0, -1.0, -1.0])
        target[:3, 3] = (0.27, y, 0.60)
        start = np.array([home[joint] for joint in arms[arm].names])
        found = arms[arm].inverse.position_solutions(target, 0.05, start)[0].q
        return dict(zip(arms[arm].names, found.tolist(), strict=True))

    gap = ArmClearance(robot.description, robot.world.model)
    states: list[tuple[int, dict[str, float]]] = []
    distances: list[float] = []
    for k, y in enumerate((-0.20, -0.10, -0.15)):
        moved = over("left", 0.05) | over("right", y)
        robot.world.reset(moved)
        states.append((k * 10**9, home | moved))
        distances.append(gap.distance(robot.world.data))
    assert distances[1] < distances[2] < distances[0]
    assert least_clearance(states) == pytest.approx(distances[1], abs=1e-9)


def sweep(robot: SimRobot, x: float = 0.27) -> dict[str, Motion]:
    """A motion of each arm over the middle of the table and back, in 4 s."""
    state = robot.states.latest()[1]
    target = np.eye(4)
    target[:3, :3] = np.diag([1.0, -1.0, -1.0])
    target[:3, 3] = (x, 0.0, 0.50)
    motions: dict[str, Motion] = {}
    for name, arm in robot.motion.arms.items():
        start = np.array([state[joint] for joint in arm.names])
        there = arm.inverse.position_solutions(target, 0.05, start)[0].q
        motions[name] = Motion(arm.names, np.array([0.0, 2.0, 4.0]), np.array([start, there, start]), np.zeros((3, 7)))
    return motions


@pytest.mark.long
def test_an_arm_that_may_not_wait_long_enough_is_refused_and_one_whose_way_is_blocked_holds() -> None:
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False))
    gap, motions = watch_clearance(robot), sweep(robot)
    answers: dict[str, MotionAnswer] = {}

    async def left() -> None:
        # cancelled over the middle of the table, where the right arm is to come
        stopped = lambda: robot.t_ns > 2_200_000_000  # noqa: E731
        answers["left"] = await robot.motion.execute(ExecuteRequest("left", motions["left"], 20.0), stopped)

    async def right() -> None:
        await robot.wait(0.05)
        answers["refused"] = await robot.motion.execute(ExecuteRequest("right", motions["right"], 0.2))
        answers["right"] = await robot.motion.execute(ExecuteRequest("right", motions["right"], 20.0))

    carry_out(robot, robot.together([left, right]))
    assert answers["refused"].code is Code.IN_COLLISION
    assert "would have to wait longer" in answers["refused"].message
    assert answers["left"].code is Code.CANCELLED
    assert answers["right"].code is Code.IN_COLLISION
    assert "the left arm stopped on its way" in answers["right"].message
    assert gap.least >= LEAST_CLEARANCE


def test_parameters_of_nodes_hold_in_process() -> None:
    sets = ("motion.map.use=off", "octomap.grid.resolution=0.04", "motion.limits.default_scale=0.2")
    robot = SimRobot(random_scene(5000), SimulatedSenses(depth_noise=False, sets=sets))
    robot.pass_time(0.1)
    assert robot.motion.scene_state().map.why == "switched off"
    assert robot.map.config.grid.resolution == 0.04
    assert robot.motion.arms["left"].scale(0.0) == 0.2


def carry_out(robot: SimRobot, work) -> None:
    for _ in range(3000):
        try:
            work.send(None)
        except StopIteration:
            return
        robot.tick()
    pytest.fail("it did not end within 30 s")
