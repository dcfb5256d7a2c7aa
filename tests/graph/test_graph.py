# SPDX-License-Identifier: Apache-2.0
"""The whole graph as processes: a grasp by service, faults, and an end that leaves nothing."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
import rclpy
from openarm_interfaces.srv import Grasp
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor

from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.shm import names_of, unused
from openarm_common.errors import Code
from openarm_common.scene.scene import load_scene
from openarm_evaluation.judging.arm_clearance import LEAST_CLEARANCE, least_clearance
from openarm_evaluation.judging.judge import judge
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import run_pair, wait_scene
from openarm_grasp.ros.client import GraspClient
from tests.graph.asking import Asked

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.alone]

#: What a grasp may say when the robot is lost under it.
LOST = {Code.ROBOT_LOST, Code.STALE_DATA, Code.EXECUTION_FAILED, Code.GRASP_LOST, Code.NOT_READY}


@pytest.fixture(scope="module")
def up(start_graph: Any) -> Any:
    """The graph `sim`, ready."""
    graph = start_graph("sim")
    graph.wait_ready()
    return graph


@pytest.fixture
def domain(up: Any, monkeypatch: pytest.MonkeyPatch) -> int:
    """Clients of this process meet the graph."""
    monkeypatch.setenv("ROS_DOMAIN_ID", str(up.domain))
    return up.domain


@pytest.fixture
def observer(domain: int) -> Iterator[Observer]:
    with Observer(domain) as watching:
        yield watching


@pytest.fixture
def client(domain: int) -> Iterator[GraspClient]:
    with GraspClient() as asking:
        yield asking


def call_grasp(domain: int, **fields: object) -> Grasp.Response:
    """Call /grasp with rclpy alone, as a user's node does."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = rclpy.create_node("plain_user", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(node)
    try:
        service = node.create_client(Grasp, "/grasp")
        assert service.wait_for_service(timeout_sec=10.0)
        future = service.call_async(Grasp.Request(**fields))
        executor.spin_until_future_complete(future, timeout_sec=120.0)
        assert future.done(), "no answer of /grasp"
        return future.result()
    finally:
        executor.shutdown()
        node.destroy_node()
        context.try_shutdown()


@pytest.mark.requirement("B-12")
def test_one_command_brings_up_every_node(up: Any) -> None:
    record = up.record()
    assert record["ready"]
    assert set(record["nodes"]) == set(load_graph("sim").nodes)
    for name in record["nodes"]:
        assert Path(record["run_dir"], "logs", f"{name}.log").is_file()


def test_unknown_object_is_refused_with_what_is_in_view(domain: int) -> None:
    answer = call_grasp(domain, label="unicorn")
    assert not answer.success
    assert answer.code in (Code.UNKNOWN_OBJECT, Code.INVALID_ARGUMENT)
    assert "red" in answer.message


def test_dry_run_plans_and_moves_nothing(up: Any, observer: Observer) -> None:
    scene = load_scene("demo")
    wait_scene(observer, scene, 0)
    observer.forget()
    done = up.openarm("pick", "red", "--dry-run", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    observer.wait(lambda: len(observer.track("red_cube")) > 5 or None, 5.0, "ground truth")
    track = observer.track("red_cube")
    assert max(float(abs(sample.p_world - track[0].p_world).max()) for sample in track) < 1e-3


@pytest.mark.requirement("A-01", "B-06")
def test_grasp_by_service_lifts_and_places_and_a_second_one_is_refused_at_once(
    domain: int, observer: Observer, client: GraspClient
) -> None:
    wait_scene(observer, load_scene("demo"), 0)
    observer.forget()
    observer.wait(lambda: observer.track("red_cube") or None, 5.0, "ground truth")
    request = Asked(observer, lambda: call_grasp(domain, label="red"))
    request.wait_state("MOVE_TO_PREGRASP")
    assert client.pick("blue").code == Code.BUSY  # the client has met the server now
    began = time.monotonic()
    assert client.pick("blue").code == Code.BUSY
    assert time.monotonic() - began < 1.0
    answer = request.result(timeout=120.0)
    assert answer.success, f"{answer.code}: {answer.message}"
    time_at_end = observer.track("red_cube")[-1].t_ns
    observer.wait(lambda: observer.track("red_cube")[-1].t_ns > time_at_end + 10**9, 20.0, "a second at rest")
    target = (answer.place_position.x, answer.place_position.y)
    verdict = judge(observer.track("red_cube"), target, claimed=True)
    assert verdict.placed, verdict.reasons
    states = [step.state for step in observer.steps()]
    for state in ("DETECT", "TRANSFORM", "PLAN", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET", "IDLE"):
        assert state in states


@pytest.mark.requirement("A-65")
def test_two_objects_are_picked_at_once_and_the_arms_keep_20_mm_apart(observer: Observer, client: GraspClient) -> None:
    scene = load_scene("demo")
    after_ns = observer.reset_world("demo", 0)
    red, blue = run_pair(observer, client, scene, ("red", "blue"), after_ns=after_ns)
    for trial, arm in ((red, "right"), (blue, "left")):
        assert trial.outcome == "placed", trial.answer.message
        assert trial.answer.arm == arm
    assert least_clearance(observer.joints()) >= LEAST_CLEARANCE
    began = {step.label: step.t_ns for step in observer.steps() if step.state == "MOVE_TO_PREGRASP"}
    ended = {step.label: step.t_ns for step in observer.steps() if step.state == "RESET"}
    assert max(began.values()) < min(ended.values())


def test_bridge_killed_during_a_grasp_is_a_named_code_and_the_graph_comes_back(
    up: Any, observer: Observer, client: GraspClient
) -> None:
    after_ns = observer.reset_world("demo", 0)
    wait_scene(observer, load_scene("demo"), after_ns)
    observer.forget()
    bridge = up.record()["nodes"]["mujoco_bridge"]["pid"]
    request = Asked(observer, lambda: client.pick("red"))
    request.wait_state("MOVE_TO_GRASP")
    os.kill(bridge, signal.SIGKILL)
    killed = time.monotonic()
    result = request.result(timeout=20.0)
    seconds = time.monotonic() - killed
    assert not result.success
    assert result.code in LOST, f"{result.code}: {result.message}"
    assert seconds < 2.0
    deadline = time.monotonic() + 60.0
    while (record := up.wait_ready())["nodes"]["mujoco_bridge"]["pid"] == bridge:
        assert time.monotonic() < deadline
    assert record["nodes"]["mujoco_bridge"]["restarts"] == 1


def test_graph_that_has_come_back_grasps_again(observer: Observer, client: GraspClient) -> None:
    after_ns = observer.reset_world("demo", 0)
    wait_scene(observer, load_scene("demo"), after_ns)
    result = client.pick("red")
    assert result.success, f"{result.code}: {result.message}"


@pytest.mark.requirement("P-34")
def test_ctrl_c_leaves_no_process_and_no_shared_memory(up: Any) -> None:
    pids = up.pids()
    assert len(pids) >= 7
    began = time.monotonic()
    assert up.stop(signal.SIGINT) == 0
    assert time.monotonic() - began < 12.0
    assert [pid for pid in pids if psutil.pid_exists(pid)] == []
    # A port that is in use belongs to another process that has joined this domain.
    assert unused(names_of(up.domain)) == []
    assert up.record() is None
    assert "no process is left" in up.output.read_text()
