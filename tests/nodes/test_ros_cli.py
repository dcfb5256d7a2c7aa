# SPDX-License-Identifier: Apache-2.0
"""The commands topic, service, action, node, param and tf against a node that runs."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from openarm_interfaces.action import Pick
from openarm_interfaces.srv import SetPause
from rclpy.action import ActionServer
from rclpy.context import Context
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_bringup import cli
from openarm_bringup.bags.ros import recorder
from openarm_bringup.commands import connect, ros2, tf
from openarm_bringup.doctor.ros import listener
from openarm_bringup.ros import peer as peer_client
from openarm_bringup.ros.peer import Frames, Peer
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import new_context
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_STATIC_TF
from tests.conftest import DEADLINE_S, RosProbe
from tests.refusals import refuses


class Graph:
    """A node with one of each kind, spinning next to the tests; what is published to it."""

    def __init__(self) -> None:
        self.ros = RosProbe()
        self.heard: list[str] = []
        node = self.node = self.ros.node
        node.declare_parameter("height", 0.5)
        node.create_publisher(String, "/status", QOS_LATCHED).publish(String(data="ready"))
        kept = QoSProfile(depth=9, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)
        steps = node.create_publisher(String, "/steps", kept)
        for step in ("up", "along", "down"):
            steps.publish(String(data=step))
        ticks = node.create_publisher(String, "/ticks", QOS_COMMAND)
        node.create_timer(0.02, lambda: ticks.publish(String(data="tick")))
        node.create_subscription(String, "/talk", lambda message: self.heard.append(message.data), QOS_COMMAND)
        node.create_service(SetPause, "/pause", self._pause)
        self._server = ActionServer(node, Pick, "/pick", self._pick)
        self.frames({"base": ("world", 1.0), "camera": ("base", 0.5)})
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._spin)
        self._thread.start()

    def frames(self, edges: dict[str, tuple[str, float]]) -> Publisher:
        """Publish the parent of each frame, and how far ahead it is of that."""
        publisher = self.node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
        message = TFMessage()
        for child, (parent, x) in edges.items():
            edge = TransformStamped(child_frame_id=child)
            edge.header.frame_id = parent
            edge.transform.translation.x = x
            edge.transform.rotation.w = 1.0
            message.transforms.append(edge)
        publisher.publish(message)
        return publisher

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        self._server.destroy()
        self.ros.close()

    @staticmethod
    def _pause(request: SetPause.Request, response: SetPause.Response) -> SetPause.Response:
        response.success, response.message = request.paused, "paused" if request.paused else "only true is taken"
        return response

    @staticmethod
    def _pick(handle) -> Pick.Result:
        handle.succeed()
        return Pick.Result(success=True, code="OK", label=handle.request.label)

    def _spin(self) -> None:
        while not self._stop.is_set():
            self.ros.executor.spin_once(timeout_sec=0.05)


@pytest.fixture(autouse=True)
def alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Graphs that run on this machine are not met."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))


@pytest.fixture(scope="module")
def running(ros_domain: int) -> Iterator[tuple[Graph, Context]]:
    """The node, and a context that has discovered it, as that of the daemon."""
    graph, context = Graph(), new_context(ros_domain)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(peer_client, "_FIRST_NODE_S", DEADLINE_S)
        with Peer(context) as resident:
            resident.spin_until(lambda: "/pick" in resident.actions() and "/tf_static" in resident.topics(), DEADLINE_S)
            yield graph, context
    context.try_shutdown()
    graph.close()


@pytest.fixture
def graph(running: tuple[Graph, Context]) -> Iterator[Graph]:
    """The node, which commands of the test know already: each discovers it for a second otherwise."""
    before = connect.PEER.set(partial(Peer, running[1], settled=True))
    yield running[0]
    connect.PEER.reset(before)


def test_topics_are_listed_echoed_measured_and_published(
    graph: Graph, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert ros2.topic_list().data["topics"]["/ticks"] == "std_msgs/msg/String"
    echoed = ros2.echo("status", count=1)  # latched: it was published long before
    assert echoed.data["messages"] == [{"data": "ready"}]
    assert ros2.echo("steps", count=1).data["messages"] == [{"data": "down"}], "the newest of those that are kept"
    assert [step["data"] for step in ros2.echo("steps", count=2).data["messages"]] == ["along", "down"]
    assert "data: ready" in capsys.readouterr().out
    assert cli.run(["topic", "echo", "status", "-n", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] == [{"data": "ready"}], "JSON, and nothing else"
    measured = ros2.hz("/ticks", seconds=0.5).data
    assert measured["rate_hz"] > 0.0
    assert 0.0 <= measured["delay_median_ms"] <= measured["delay_max_ms"]
    assert ros2.pub("/talk", "{data: hello}", count=2, rate=20.0).success
    deadline = time.monotonic() + DEADLINE_S
    while len(graph.heard) < 2 and time.monotonic() < deadline:
        threading.Event().wait(0.01)  # the node takes them in a thread of its own
    assert graph.heard == ["hello", "hello"]
    in_time = Peer.spin_until
    monkeypatch.setattr(Peer, "spin_until", lambda peer, what, seconds: in_time(peer, what, min(seconds, 0.1)))
    alone = ros2.pub("/unheard", "std_msgs/msg/String")
    assert (alone.success, alone.code) == (False, Code.NOT_READY)


@pytest.mark.parametrize(
    ("words", "most", "hertz"),
    [
        ({}, 1.0, 10.0),
        ({"once": True}, 1.0, 10.0),
        ({"rate": 50.0}, float("inf"), 50.0),
        ({"rate": 50.0, "duration": 2.0}, 100.0, 50.0),
        ({"duration": 2.0}, 20.0, 10.0),
        ({"count": 7}, 7.0, 10.0),
        ({"rate": 50.0, "duration": 2.0, "count": 7}, 7.0, 50.0),
    ],
)
def test_what_a_stream_is(words: dict[str, Any], most: float, hertz: float) -> None:
    every = {"rate": None, "duration": None, "count": None, "once": False}
    assert ros2._stream(**{**every, **words}) == (most, hertz)


@pytest.mark.parametrize(
    "words",
    [
        ("--rate", "0"),
        ("--rate", "-5"),
        ("--rate", "nan"),
        ("--rate", "inf"),
        ("--duration", "-1"),
        ("--count", "0"),
        ("--once", "--rate", "5"),
        ("--once", "--count", "5"),
    ],
)
def test_a_stream_that_cannot_be_is_refused(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.run(["topic", "pub", "/talk", "{data: a}", *words]) == 2
    assert words[-2] in capsys.readouterr().err


def test_services_and_actions_are_called_and_the_exit_code_follows_the_answer(graph: Graph) -> None:
    listed = ros2.service_list().data["services"]
    assert (listed["/pause"], "/probe/set_parameters" in listed) == ("openarm_interfaces/srv/SetPause", False)
    assert "/probe/set_parameters" in ros2.service_list(all_=True).data["services"]
    assert ros2.call("/pause", "{paused: true}").exit_code == 0
    refused = ros2.call("pause", "{paused: false}")
    assert (refused.exit_code, refused.message) == (1, "only true is taken")
    assert ros2.action_list().data["actions"]["/pick"] == "openarm_interfaces/action/Pick"
    assert ros2.send("/pick", "{label: red}").data["answer"]["label"] == "red"
    assert ros2.call("/pause", "openarm_interfaces/srv/SetPause", "{paused: true}").success, "as ros2 is called"
    with pytest.raises(OpenArmError, match="/pause has the type openarm_interfaces/srv/SetPause, not std_srvs"):
        ros2.call("/pause", "std_srvs/srv/Empty")
    with pytest.raises(OpenArmError, match=r"expected one YAML mapping, got '\{paused: true\}'"):
        ros2.call("/pause", "{paused:", "true}")


def test_mistakes_are_met_with_a_suggestion(graph: Graph) -> None:
    for command, said in (
        (lambda: ros2.echo("/statsu"), "did you mean /status"),
        (lambda: ros2.call("/paus"), "did you mean /pause"),
        (lambda: ros2.call("/pause", "{pause: true}"), "did you mean paused"),
        (lambda: ros2.call("/pause", "{"), "is not valid YAML"),
        (lambda: ros2.send("/pikc"), "did you mean /pick"),
        (lambda: ros2.param_get("prob", "height"), "did you mean /probe"),
        (lambda: ros2.param_get("probe", "heigth"), "did you mean height"),
        (lambda: tf.echo("world", "camra"), "did you mean camera"),
    ):
        with refuses(Code.INVALID_ARGUMENT, said):
            command()


def test_without_nodes_every_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(peer_client, "_FIRST_NODE_S", 0.1)
    monkeypatch.setattr(recorder, "_KNOWN_S", 0.1)
    domain = reserve_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))
    for command in (["topic", "list"], ["service", "call", "/grasp"], ["tf", "tree"], ["param", "dump", "grasp"]):
        assert cli.run([*command, "--json"]) == 1
        answer = json.loads(capsys.readouterr().out)
        assert answer["code"] == Code.NOT_READY
        assert f"no node is discovered in domain {domain} " in answer["message"]
    bag = tmp_path / "bag"
    assert cli.run(["record", str(bag), "--duration", "0.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["code"] == Code.NOTHING_DETECTED
    assert not bag.exists(), "its name is free for the next try"
    release_domain(domain)


def test_nodes_and_parameters(graph: Graph) -> None:
    assert "/probe" in ros2.node_list().data["nodes"]
    info = ros2.info("probe")
    assert info.data["publishes"]["/ticks"] == "std_msgs/msg/String"
    assert info.data["offers"]["/pause"] == "openarm_interfaces/srv/SetPause"
    assert info.data["offers actions"] == {"/pick": "openarm_interfaces/action/Pick"}
    assert "_action" not in info.text
    assert "height" in ros2.param_list("probe").data["parameters"]
    assert ros2.param_set("probe", "height", "0.7").success
    assert ros2.param_get("probe", "height").text == "0.7"
    assert "ros__parameters:" in ros2.param_dump("probe").text
    wrong = ros2.param_set("probe", "height", "tall")
    assert not wrong.success
    assert "--set probe.height=tall" in wrong.message


def test_nodes_say_how_they_are(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "_RATES_S", 0.5)
    monkeypatch.setattr(listener, "_LISTEN_S", DEADLINE_S)
    monkeypatch.setattr(listener, "_ready", lambda _: {"arm", "eye"})
    node = graph.node
    reports = node.create_publisher(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    levels = {"arm: status": DiagnosticStatus.OK, "eye: status": DiagnosticStatus.ERROR}
    status = [DiagnosticStatus(name=name, level=level, message="as it is") for name, level in levels.items()]
    clock = node.create_publisher(Clock, "/clock", 10)
    timers = [
        node.create_timer(0.02, lambda: reports.publish(DiagnosticArray(status=status))),
        node.create_timer(0.01, lambda: clock.publish(Clock())),
    ]
    outcome = ros2.health()
    for timer in timers:
        node.destroy_timer(timer)
    assert (outcome.success, outcome.message) == (False, "eye: not well")
    assert outcome.data["diagnostics"] == {"arm": (True, "as it is"), "eye": (False, "as it is")}
    assert outcome.data["nodes"].count("probe") == 1
    assert outcome.data["rates"]["/clock"] > 0.0
    assert outcome.text.splitlines()[1].split() == ["eye", "error", "as", "it", "is"]


def listens(monkeypatch: pytest.MonkeyPatch, enough: Callable[[Frames], object]) -> None:
    """Let commands listen to frames until it is enough."""
    monkeypatch.setattr(tf, "_LISTEN_S", DEADLINE_S)
    for_a_while = tf._listen
    monkeypatch.setattr(tf, "_listen", lambda domain, connected=enough: for_a_while(domain, connected))


@pytest.mark.requirement("B-35")
def test_the_tree_of_frames_is_shown_and_drawn(graph: Graph, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listens(monkeypatch, lambda frames: len(frames.edges) == 2)
    out = tmp_path / "tree.png"
    assert tf.tree(out=out).text.splitlines() == ["world", "  base", "    camera"]
    assert cv2.imread(str(out)).shape[0] > 60
    assert tf.echo("world", "camera").data["position"] == [1.5, 0.0, 0.0]
    with pytest.raises(OpenArmError, match=r"ends in \.png, \.svg or \.pdf"):
        tf.tree(out=tmp_path / "tree.jpg")


def test_a_frame_with_two_publishers_is_named(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> None:
    listens(monkeypatch, lambda frames: frames.clashes)
    second = graph.frames({"camera": ("world", 0.0)})
    tree = tf.tree()
    graph.node.destroy_publisher(second)
    assert (tree.success, list(tree.data["clashes"])) == (False, ["camera"])
    assert "camera has the parents" in tree.message
    monkeypatch.setattr(Peer, "frames", lambda *_: Frames())
    with pytest.raises(OpenArmError, match="nothing on /tf and /tf_static"):
        tf.tree()
