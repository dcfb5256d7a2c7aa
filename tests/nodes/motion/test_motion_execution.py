# SPDX-License-Identifier: Apache-2.0
"""The motion node against a fake robot (see conftest.py): execution and what disturbs it."""

from __future__ import annotations

import itertools
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from openarm_interfaces.action import ExecuteTrajectory

from openarm_common.ros.convert import trajectory_from_msg, trajectory_to_msg
from openarm_motion.timing.trajectory import Trajectory
from tests.nodes.motion.conftest import SLOWER


# --- execution
def test_a_bad_trajectory_is_refused_with_joint_and_value(bench) -> None:
    good = bench.slow_plan()
    names, t, q, v, a = trajectory_from_msg(good)
    cases = []
    cases.append((["elbow", *names[1:]], q, "INVALID_ARGUMENT", "unknown elbow"))
    wrong = q.copy()
    wrong[3, 2] = np.nan
    cases.append((names, wrong, "INVALID_ARGUMENT", "openarm_right_joint3 at point 3 is nan"))
    wrong = q.copy()
    wrong[3, 3] = 4.0
    cases.append((names, wrong, "LIMITS", "openarm_right_joint4 at point 3 is 4.0000 rad"))
    for joints, positions, code, text in cases:
        message = trajectory_to_msg(joints, t, positions, v, a)
        bench.refused(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=message), code, text)
    assert not bench.robot.active


def test_a_motion_that_is_withdrawn_before_its_controller_answers_is_cancelled_with_the_answer(bench) -> None:
    motion = Trajectory(*trajectory_from_msg(bench.slow_plan()))
    goal = bench.node.robot.controller("right").start(motion, 0, touches=True)
    goal.cancel()
    bench.ros.spin_until(lambda: goal.outcome is not None, what="its end")
    assert bench.robot.cancelled == ["right"]


def test_the_controllers_reason_is_passed_on(bench) -> None:
    def violate(result: FollowJointTrajectory.Result) -> None:
        result.error_code, result.error_string = result.PATH_TOLERANCE_VIOLATED, "joint2 0.08 rad off the path"

    bench.robot.answer = violate
    why = "PATH_TOLERANCE_VIOLATED: joint2 0.08 rad off the path"
    bench.refused(bench.move_client, bench.named(), "EXECUTION_FAILED", why)
    bench.robot.accept = False
    bench.refused(bench.move_client, bench.named("left"), "EXECUTION_FAILED", "rejected")


@pytest.mark.requirement("B-40")
def test_the_tool_must_end_within_its_tolerance(bench) -> None:
    arm, goal = bench.node.service.arms["right"], bench.description.group_state("right_arm", "official_home")
    q = np.array([goal[name] for name in arm.names])
    ways = [0.019 * np.array(signs) for signs in itertools.product((-1, 1), repeat=7)]  # within each joint's tolerance
    far = [np.linalg.norm(arm.kinematics.fk(q + way)[:3, 3] - arm.kinematics.fk(q)[:3, 3]) for way in ways]
    worst = ways[int(np.argmax(far))]
    bench.robot.sag = dict(zip(arm.names, worst.tolist(), strict=True))
    why = f"the tool ended {max(far) * 1e3:.1f} mm from its goal, expected within 10"
    bench.refused(bench.move_client, bench.named(), "EXECUTION_FAILED", why)
    bench.robot.sag = dict(zip(arm.names, (0.3 * worst).tolist(), strict=True))
    assert bench.run(bench.move_client, bench.named("right", "home")).success


def test_a_silent_robot_ends_a_motion_within_two_seconds(bench) -> None:
    _, future = bench.begin("right", bench.slow_plan())
    bench.robot.silent = True
    begin_ns = bench.robot.t_ns
    result = bench.ros.result(future).result
    assert bench.robot.t_ns - begin_ns < 2e9 * SLOWER  # a clock of this executor: a halt of the machine does not count
    assert (result.success, result.code) == (False, "ROBOT_LOST")
    assert "no /joint_states" in result.message
    # and nothing new is begun
    bench.ros.spin_until(lambda: bench.node.robot.state_age() > 1.3, what="old joint states")
    bench.refused(bench.move_client, bench.named("left"), "NOT_READY", "no fresh /joint_states")


@pytest.mark.long
def test_a_controller_that_vanishes_ends_a_motion_within_two_seconds(bench) -> None:
    _, future = bench.begin("right", bench.slow_plan())
    begin_ns = bench.robot.t_ns
    bench.robot.servers["right"].destroy()
    bench.robot.ignore_regions.add("right")
    result = bench.ros.result(future).result
    assert bench.robot.t_ns - begin_ns < 2e9 * SLOWER
    assert (result.success, result.code) == (False, "ROBOT_LOST")


@pytest.mark.long
def test_stopping_the_motion_process_on_the_way_holds_the_arm(make_bench) -> None:
    bench = make_bench(motion=False)
    command = [sys.executable, "-m", "openarm_motion.ros.node"]
    with subprocess.Popen(command, env=os.environ, stderr=subprocess.DEVNULL) as process:
        try:
            bench.ros.spin_until(bench.move_client.server_is_ready, what="the process")
            deadline = time.monotonic() + 60.0
            while not (plan := bench.slow_plan()).points:  # it has not heard the robot or met its controllers yet
                assert time.monotonic() < deadline, "the process does not plan"
            bench.start(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=plan))
            bench.ros.spin_until(lambda: "right" in bench.robot.active, what="the arm to start")
            process.send_signal(signal.SIGTERM)
            bench.ros.spin_until(lambda: process.poll() is not None, what="its end")
        finally:
            process.kill()
    assert process.returncode == 0
    assert bench.robot.cancelled == ["right"]
    assert not bench.robot.active
