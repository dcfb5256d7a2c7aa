# SPDX-License-Identifier: Apache-2.0
"""Nodes of a running graph are killed or stopped in the middle of a grasp; what docs/interfaces.md states of that."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from std_srvs.srv import Trigger

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import load_scene
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import wait_scene
from openarm_grasp.ros.client import GraspClient, GraspResult
from openarm_motion.ros.client import MotionClient
from tests.graph.asking import Asked
from tests.graph.control_log import ControlLog, hanging, last_move_ns

pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.alone, pytest.mark.usefixtures("fresh")]

#: The deadline that /joint_states are offered with, s.
DEADLINE = 0.2
#: From so long after an arm is held in a fast motion, s, it rings by no more than this, rad.
SETTLED, RINGING = 0.3, 0.020


@pytest.fixture(scope="module")
def up(start_graph: Any) -> Any:
    """The graph `sim`, ready, which moves fast, keeps few pictures and lets a busy machine detect late.

    Joint states may stay away for longer than usual: Fast DDS halts who sends through shared memory to a process that
    has just ended or hangs, for up to a second for each such process.
    """
    settings = (
        "flight_recorder.image_rate=1.0",
        "grasp.velocity_scale=1.0",
        "grasp.detect.max_age=3.0",
        "grasp.limits.joint_state_timeout=4.0",
        "motion.execution.stale_after=4.0",
    )
    graph = start_graph("sim", *(word for setting in settings for word in ("--set", setting)))
    graph.wait_ready()
    return graph


@pytest.fixture
def control(domain: int) -> Iterator[ControlLog]:
    with ControlLog(domain) as log:
        yield log


@pytest.fixture
def fresh(observer: Observer) -> None:
    """The scene demo, untouched, and the robot at home."""
    wait_scene(observer, load_scene("demo"), observer.reset_world("demo", 0))


def picking(observer: Observer, client: GraspClient, label: str) -> Asked[GraspResult]:
    """Ask the right arm for an object."""
    return Asked(observer, lambda: client.pick(label, arm="right"))


def height(observer: Observer) -> float:
    """Of the middle of the red cube, m."""
    return float(observer.track("red_cube")[-1].p_world[2])


@pytest.mark.requirement("R-21")
def test_the_emergency_stop_works_while_motion_grasp_and_supervisor_hang(
    up: Any, observer: Observer, client: GraspClient, control: ControlLog
) -> None:
    for name in ("/stop", "/mujoco_bridge/reset"):  # who stops an arm has met the bridge before
        assert control.call(Trigger, name, Trigger.Request(), 20.0).success
    request = picking(observer, client, "red")
    control.wait_swing(0.5)  # on the way to the pre-grasp
    with hanging(up.node("motion").pid, up.node("grasp").pid, up.process.pid):
        answer = control.call(Trigger, "/stop", Trigger.Request(), 20.0)
        answered_ns = time.time_ns()
        assert answer.success, answer.message
        held_ns = control.robot_time_at(answered_ns) + 50_000_000
        control.from_on(held_ns, 0.4)
    try:
        result = request.result(timeout=30.0)
    finally:
        done = up.openarm("stop", "--reset")
    assert done.returncode == 0, done.stdout + done.stderr
    held = [moment.reference for moment in control.moments if moment.t_ns >= held_ns]
    assert len(held) > 30
    assert np.abs(np.array(held) - held[0]).max() < 1e-9
    assert result.code == Code.STOPPED, f"{result.code}: {result.message}"
    with MotionClient() as motion:
        assert motion.move_to_named("right", "home").raise_for_code()


@pytest.mark.requirement("R-21")
def test_motion_killed_while_an_arm_moves_is_named_the_arm_holds_and_the_next_pick_succeeds(
    up: Any, observer: Observer, client: GraspClient, control: ControlLog
) -> None:
    motion = up.node("motion").pid
    request = picking(observer, client, "red")
    control.wait_swing(0.5)  # on the way to the pre-grasp
    killed, killed_ns = time.monotonic(), time.time_ns()
    os.kill(motion, signal.SIGKILL)
    result = request.result(timeout=20.0)
    seconds = time.monotonic() - killed
    at_ns = control.robot_time_at(killed_ns)
    after = control.from_on(at_ns, 1.0)
    assert result.code == Code.ROBOT_LOST, f"{result.code}: {result.message}"
    assert "move to the pre-grasp: the node motion is gone" in result.message
    assert seconds < 2.0
    held_ns = last_move_ns(after)
    assert held_ns - at_ns <= 200_000_000
    settled = [m for m in after if m.t_ns > held_ns + SETTLED * 1e9]
    assert max(float(np.abs(m.position - m.reference).max()) for m in settled) < RINGING
    up.wait_back("motion", motion)
    again = client.pick("red", arm="right")
    assert again.success, f"{again.code}: {again.message}"


@pytest.mark.requirement("R-21", "P-01")
def test_grasp_killed_in_lift_is_named_and_its_successor_opens_no_hand_that_holds_something(
    up: Any, observer: Observer, client: GraspClient
) -> None:
    grasp = up.node("grasp").pid
    request = picking(observer, client, "red")
    observer.wait(lambda: observer.track("red_cube") or None, 20.0, "ground truth")
    stood = height(observer)
    request.wait_state("LIFT")
    observer.wait(lambda: height(observer) > stood + 0.03, 20.0, "an object in the air")
    killed = time.monotonic()
    os.kill(grasp, signal.SIGKILL)
    with pytest.raises(OpenArmError, match="the node grasp is gone") as lost:
        request.result(timeout=20.0)
    assert time.monotonic() - killed < 2.0
    assert lost.value.code is Code.NOT_READY
    up.wait_back("grasp", grasp)
    refused = client.pick("green", arm="right")
    assert refused.code == Code.NOT_READY, f"{refused.code}: {refused.message}"
    assert "the right hand still holds 'red'" in refused.message
    heights = [sample.p_world[2] for sample in observer.track("red_cube")]
    lifted = next(k for k, z in enumerate(heights) if z > stood + 0.03)
    assert min(heights[lifted:]) > heights[lifted] - 0.010, "it has fallen"
    placed = client.pick(phase="place")
    assert placed.success, f"{placed.code}: {placed.message}"
    place = observer.track("red_cube")[-1].p_world
    assert np.hypot(*(place[:2] - placed.place_position[:2])) < 0.02
    assert abs(place[2] - stood) < 0.005


# The last one: where a process was stopped for so long, ports of shared memory may stay broken.
@pytest.mark.requirement("N-23")
def test_joint_states_go_on_while_a_node_hangs_that_reads_them(up: Any, control: ControlLog) -> None:
    control.wait(lambda: len(control.joint_states_ns) > 100, 20.0, "joint states")
    with hanging(up.node("octomap").pid):
        since_ns = control.joint_states_ns[-1]
        control.wait(lambda: control.joint_states_ns[-1] > since_ns + 3 * 10**9, 20.0, "3 s of joint states")
    control.wait(lambda: control.joint_states_ns[-1] > since_ns + 4 * 10**9, 20.0, "another second")
    gaps = np.diff(control.joint_states_ns) * 1e-9
    assert gaps.max() < DEADLINE
