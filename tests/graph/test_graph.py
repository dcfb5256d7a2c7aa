# SPDX-License-Identifier: Apache-2.0
"""The whole graph as processes: what docs/interfaces.md states of it, a grasp, faults, an end that leaves nothing."""

from __future__ import annotations

import json
import os
import re
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest
import rclpy
from geometry_msgs.msg import Point
from openarm_interfaces.srv import ClearFaults, Grasp, InjectFault, QueryMap
from rcl_interfaces.srv import ListParameters
from rclpy.node import Node
from tf2_msgs.msg import TFMessage

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.commands.record import check
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.shm import mapped_by, names_of, unused
from openarm_common.domain import reserve_domain
from openarm_common.errors import Code
from openarm_common.ros.node import QOS_STATIC_TF, QOS_TF
from openarm_common.scene.scene import load_scene
from openarm_evaluation.judging.arm_clearance import LEAST_CLEARANCE, least_clearance
from openarm_evaluation.judging.judge import JudgeConfig, judge
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import run_pair, wait_scene
from openarm_grasp.ros.client import GraspClient
from tests.conftest import DEADLINE_S
from tests.graph import contract
from tests.graph.asking import Asked, until, user

pytestmark = [pytest.mark.graph, pytest.mark.alone]

#: What a grasp may say when the robot is lost under it.
LOST = {Code.ROBOT_LOST, Code.STALE_DATA, Code.EXECUTION_FAILED, Code.GRASP_LOST, Code.NOT_READY}


@pytest.fixture(scope="module")
def up(start_graph: Any) -> Any:
    """The graph `sim`, whose true camera mounts only the calibration knows, ready; recordings with few pictures."""
    graph = start_graph("sim", "--moveit", "--set", "flight_recorder.image_rate=1.0")
    graph.wait_ready()
    return graph


@pytest.fixture(scope="class")
def visitor(up: Any) -> Iterator[Node]:
    """A user's node, spun by tests; one for each: when nodes leave, Fast DDS may hold who stays (Fast-DDS#6502)."""
    with user(up.domain) as node:
        yield node


def call(node: Node, kind: Any, name: str, /, **fields: object) -> Any:
    """Call a service with rclpy alone, as a user's node does."""
    client = node.create_client(kind, name)
    try:
        assert client.wait_for_service(timeout_sec=DEADLINE_S), f"{name} is not there"
        future = client.call_async(kind.Request(**fields))
        rclpy.spin_until_future_complete(node, future, timeout_sec=240.0)
        assert future.done(), f"no answer of {name}"
        return future.result()
    finally:
        node.destroy_client(client)


def waiting_plan(observer: Observer) -> str | None:
    """The id of the plan that waits for /grasp/confirm."""
    steps = observer.steps()
    found = re.search(r"plan '(\w+)' waits", steps[-1].reason) if steps else None
    return found[1] if found else None


def kept_of(up: Any, recording: str) -> tuple[dict[str, str], dict[str, int]]:
    """What a flight recording says of itself, and messages by topic."""
    path = Path(recording)
    assert path.parent == Path(up.wait_ready().run_dir, "recordings")
    deadline = time.monotonic() + 60.0
    while not path.exists():
        assert time.monotonic() < deadline, f"{path} is not written"
        time.sleep(0.05)
    with open_bag(path) as bag:
        for topic in ("/overhead/color/image_raw", "/overhead/depth/image_raw", "/wrist/depth/image_raw"):
            assert bag.counts[topic] > 0, "colour while the grasp looks, depth always"
        assert bag.counts["/joint_states"] > 0
        return dict(bag.custom), bag.counts


@pytest.mark.requirement("B-12")
def test_one_command_brings_up_every_node(up: Any) -> None:
    record = up.record()
    assert record["ready"]
    assert set(record["nodes"]) == set(load_graph("sim").nodes)
    for name in record["nodes"]:
        assert Path(record["run_dir"], "logs", f"{name}.log").is_file()


class TestInterfaces:
    """What docs/interfaces.md states."""

    def test_topics_have_the_stated_type_publishers_and_qos(self, visitor: Node) -> None:
        topics = contract.settled(visitor)
        rows = [row for row in contract.ROW.findall(contract.INTERFACES) if "/msg/" in row[1]]
        assert len(rows) >= 25
        assert {name: contract.publishers(visitor, name) for name, _, _ in rows} == contract.stated_publishers()
        for name, kind, rest in rows:
            assert topics[name] == [kind], name
            for info in visitor.get_publishers_info_by_topic(name):
                qos = (info.qos_profile.reliability, info.qos_profile.durability)
                assert qos == contract.QOS[rest.split("|")[0].strip()], name

    def test_every_topic_is_stated(self, visitor: Node) -> None:
        stated = {name for name, _, _ in contract.ROW.findall(contract.INTERFACES)}
        missing = [
            name for name in contract.settled(visitor) if name not in stated and not contract.IMPLICIT.search(name)
        ]
        assert missing == []

    def test_services_and_actions_have_the_stated_type_and_node(self, visitor: Node) -> None:
        contract.settled(visitor)
        rows = {
            name: (kind, rest.split("|")[0].strip())
            for name, kind, rest in contract.ROW.findall(contract.INTERFACES)
            if "/msg/" not in kind
        }
        assert len(rows) >= 14
        found = until(visitor, lambda: contract.services(visitor), lambda found: found == rows)
        assert found == rows

    def test_parameters_exist_at_their_nodes(self, visitor: Node) -> None:
        stated = contract.stated_parameters()
        assert {"mujoco_bridge", "detector", "octomap", "motion", "grasp"} <= stated.keys()
        for node, names in stated.items():
            answer = call(visitor, ListParameters, f"/{node}/list_parameters")
            assert names <= set(answer.result.names), node

    @pytest.mark.requirement("P-31")
    def test_who_takes_images_unasked_is_a_lifecycle_node(self, visitor: Node) -> None:
        contract.settled(visitor)
        managed = {
            node
            for name, (kind, node) in contract.services(visitor).items()
            if kind == "lifecycle_msgs/srv/ChangeState"
        }
        assert managed == {"octomap", "flight_recorder"}
        for topic in ("/overhead/color/image_raw", "/overhead/depth/image_raw", "/wrist/depth/image_raw"):
            taking = {info.node_name for info in visitor.get_subscriptions_info_by_topic(topic)}
            assert taking <= managed, topic

    @pytest.mark.requirement("A-73")
    def test_one_publisher_for_each_edge_of_the_frame_tree(self, visitor: Node) -> None:
        parents: dict[str, set[tuple[str, str]]] = {}

        def note(kind: str, message: TFMessage) -> None:
            for edge in message.transforms:
                parents.setdefault(edge.child_frame_id, set()).add((edge.header.frame_id, kind))

        taken = [
            visitor.create_subscription(TFMessage, "/tf", lambda m: note("/tf", m), QOS_TF),
            visitor.create_subscription(TFMessage, "/tf_static", lambda m: note("/tf_static", m), QOS_STATIC_TF),
        ]
        wanted = {"overhead_color_optical_frame", "wrist_link", "openarm_right_hand_tcp", "openarm_left_link7", "table"}
        until(visitor, parents.keys, lambda found: wanted <= found)
        for subscription in taken:
            visitor.destroy_subscription(subscription)
        assert wanted <= parents.keys()
        assert {child: edges for child, edges in parents.items() if len(edges) > 1} == {}
        roots = {parent for edges in parents.values() for parent, _ in edges} - parents.keys()
        assert roots == {"world"}


@pytest.mark.requirement("R-24")
def test_unknown_object_is_refused_with_what_is_in_view_and_leaves_a_recording(up: Any, visitor: Node) -> None:
    answer = call(visitor, Grasp, "/grasp", label="unicorn")
    assert not answer.success
    assert answer.code == Code.UNKNOWN_OBJECT
    assert "red" in answer.message
    custom, counts = kept_of(up, answer.recording)
    assert custom["reason"] == f"UNKNOWN_OBJECT: {answer.message}"
    assert custom["again"] == "openarm pick unicorn"
    assert (custom["graph"], "openarm-vision" in custom) == ("sim", True)
    assert {"/tf_static", "/robot_description", "/octomap_binary", "/grasp/status", "/detections_3d"} <= counts.keys()


@pytest.mark.long
@pytest.mark.requirement("R-24")
def test_a_recording_of_a_failure_is_checked_and_replayed(up: Any, visitor: Node) -> None:
    recording = call(visitor, Grasp, "/grasp", label="unicorn").recording
    _, counts = kept_of(up, recording)
    checked = check(Path(recording))
    assert checked.success, checked.message
    assert checked.data["again"] == "openarm pick unicorn"
    assert checked.data["numbers"]["detection/overhead/red/frames"] > 0
    done = up.openarm("replay", recording, "--rate", "0", "--domain", str(reserve_domain()), "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout)["messages"] == sum(counts.values())


@pytest.mark.long
def test_dry_run_plans_and_moves_nothing(up: Any, observer: Observer) -> None:
    scene = load_scene("demo")
    wait_scene(observer, scene, 0)
    observer.forget()
    done = up.openarm("pick", "red", "--dry-run", "--json")
    assert done.returncode == 0, done.stdout + done.stderr
    observer.wait(lambda: len(observer.track("red_cube")) > 5 or None, 60.0, "ground truth")
    track = observer.track("red_cube")
    assert max(float(abs(sample.p_world - track[0].p_world).max()) for sample in track) < 1e-3


@pytest.mark.long
@pytest.mark.requirement("A-32", "R-15")
def test_with_wrong_intrinsics_a_grasp_is_refused_with_that_code_and_nothing_moves(
    visitor: Node, observer: Observer
) -> None:
    wait_scene(observer, load_scene("demo"), 0)
    bias = "{camera: overhead, focal: 0.48}"
    assert call(visitor, InjectFault, "/sim/inject_fault", name="intrinsics_bias", parameters=bias).success
    try:
        observer.forget()
        answer = call(visitor, Grasp, "/grasp", label="red")
    finally:
        assert call(visitor, ClearFaults, "/sim/clear_faults").success
    assert answer.code == Code.INTRINSICS_MISMATCH, answer.message
    assert not {step.state for step in observer.steps()} & {"PLAN", "MOVE_TO_PREGRASP"}


@pytest.mark.requirement("A-01", "B-06", "P-16", "P-20", "R-25")
def test_a_confirmed_grasp_by_service_places_within_5_mm_around_what_only_the_map_knows_and_a_second_one_is_refused(
    visitor: Node, observer: Observer, client: GraspClient
) -> None:
    """What fails without calibration, and without the map: `tests/openarm_evaluation/test_chain.py`.

    While it runs no node of the graph subscribes to ground truth.
    """
    scene = load_scene("screen")
    wait_scene(observer, scene, observer.reset_world("screen", 0))
    middle = Point(**dict(zip("xyz", scene.object("screen").centre(scene.table), strict=True)))
    middle.z += 0.09  # what the camera sees is the top

    def state() -> int | None:
        answer = call(visitor, QueryMap, "/octomap/query", points=[middle])
        return answer.states[0] if answer.success else None

    occupied = QueryMap.Response.OCCUPIED
    assert until(visitor, state, lambda seen: seen == occupied) == occupied, "the screen in the map"
    place = Point(x=0.26, y=0.43)
    fields = {"label": "red", "has_place_position": True, "place_position": place, "confirm": True}
    request = Asked(observer, lambda: call(visitor, Grasp, "/grasp", **fields))
    plan_id = observer.wait(lambda: waiting_plan(observer), 60.0, "a plan that waits")
    assert "MOVE_TO_PREGRASP" not in {step.state for step in observer.steps()}
    assert client.confirm(plan_id, accept=True).raise_for_code()
    request.wait_state("MOVE_TO_PREGRASP")
    assert client.pick("blue").code == Code.BUSY
    assert not request.done()
    readers: set[str] = set()

    def ended() -> bool:
        readers.update(observer.subscribers("/sim/ground_truth/objects"))
        return request.done()

    observer.wait(ended, 240.0, "the end of the grasp")
    assert readers == {"openarm_observer"}  # of this test
    answer = request.result(timeout=1.0)
    assert answer.success, f"{answer.code}: {answer.message}"
    time_at_end = observer.track("red_box")[-1].t_ns
    observer.wait(lambda: observer.track("red_box")[-1].t_ns > time_at_end + 10**9, 60.0, "a second at rest")
    rules = JudgeConfig(place_tolerance=0.005)
    verdict = judge(observer.track("red_box"), (place.x, place.y), claimed=True, rules=rules)
    assert verdict.placed, verdict.reasons
    screen = observer.track("screen")
    assert max(float(np.linalg.norm(sample.p_world - screen[0].p_world)) for sample in screen) < 1e-3
    states = [step.state for step in observer.steps()]
    for state in ("DETECT", "TRANSFORM", "PLAN", "MOVE_TO_GRASP", "CLOSE_GRIPPER", "LIFT", "PLACE", "RESET", "IDLE"):
        assert state in states


@pytest.mark.long
@pytest.mark.requirement("R-24")
def test_bridge_killed_during_a_grasp_is_a_named_code_and_the_graph_comes_back(
    up: Any, observer: Observer, client: GraspClient
) -> None:
    after_ns = observer.reset_world("demo", 0)
    wait_scene(observer, load_scene("demo"), after_ns)
    bridge = up.node("mujoco_bridge").pid
    request = Asked(observer, lambda: client.pick("red"))
    request.wait_state("MOVE_TO_GRASP")
    os.kill(bridge, signal.SIGKILL)
    killed = time.monotonic()
    result = request.result(timeout=20.0)
    seconds = time.monotonic() - killed
    assert not result.success
    assert result.code in LOST, f"{result.code}: {result.message}"
    assert seconds < 2.0
    up.wait_back("mujoco_bridge", bridge)
    assert up.node("mujoco_bridge").restarts == 1
    custom, counts = kept_of(up, result.recording)
    assert custom["reason"].startswith(f"{result.code}: ")
    assert custom["again"] == "openarm pick red"
    assert counts["/grasp/status"] >= 4, "the states that it went through"


@pytest.mark.long
@pytest.mark.requirement("A-65")
def test_the_graph_that_has_come_back_picks_two_objects_at_once_and_the_arms_keep_20_mm_apart(
    observer: Observer, client: GraspClient
) -> None:
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


def _runs(process: psutil.Process) -> bool:
    """Whether a process goes on: one that ended may wait for init to take note, and its number may be another's."""
    try:
        return process.is_running() and process.status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


@pytest.mark.requirement("P-34")
def test_ctrl_c_leaves_no_process_and_no_shared_memory(up: Any) -> None:
    processes = [psutil.Process(pid) for pid in up.pids()]
    assert len(processes) >= 7
    mine = mapped_by(os.getpid())
    assert up.stop(signal.SIGINT, seconds=60.0) == 0
    assert [one for one in processes if _runs(one)] == []
    # A port that is in use belongs to another process that has joined this domain, as this one may have until now.
    assert set(unused(names_of(up.domain))) <= mine
    assert up.record() is None
    assert "no process is left" in up.output.read_text()
