# SPDX-License-Identifier: Apache-2.0
"""The commands topic, service, action, node, param and tf against a node that runs."""

from __future__ import annotations

import json
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import TransformStamped
from openarm_interfaces.action import Pick
from openarm_interfaces.srv import SetPause
from rclpy.action import ActionServer
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_msgs.msg import String
from tf2_msgs.msg import TFMessage

from openarm_bringup import cli
from openarm_bringup.commands import ros2, tf
from openarm_bringup.doctor.ros import listener
from openarm_bringup.ros import peer as peer_client
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED, QOS_STATIC_TF
from tests.conftest import DEADLINE_S


@pytest.fixture
def heard(ros, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """A node with one of each kind, spinning next to the test; what is published to it."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))  # graphs that run on this machine are not met
    heard: list[str] = []
    node = ros.node
    node.declare_parameter("height", 0.5)
    node.create_publisher(String, "/status", QOS_LATCHED).publish(String(data="ready"))
    steps = node.create_publisher(
        String, "/steps", QoSProfile(depth=9, reliability=QOS_LATCHED.reliability, durability=QOS_LATCHED.durability)
    )
    for step in ("up", "along", "down"):
        steps.publish(String(data=step))
    ticks = node.create_publisher(String, "/ticks", QOS_COMMAND)
    node.create_timer(0.02, lambda: ticks.publish(String(data="tick")))
    node.create_subscription(String, "/talk", lambda message: heard.append(message.data), QOS_COMMAND)

    def pause(request: SetPause.Request, response: SetPause.Response) -> SetPause.Response:
        response.success, response.message = request.paused, "paused" if request.paused else "only true is taken"
        return response

    def pick(handle) -> Pick.Result:
        handle.succeed()
        return Pick.Result(success=True, code="OK", label=handle.request.label)

    node.create_service(SetPause, "/pause", pause)
    server = ActionServer(node, Pick, "/pick", pick)
    frames = node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
    message = TFMessage()
    for parent, child, x in (("world", "base", 1.0), ("base", "camera", 0.5)):
        edge = TransformStamped(child_frame_id=child)
        edge.header.frame_id = parent
        edge.transform.translation.x = x
        edge.transform.rotation.w = 1.0
        message.transforms.append(edge)
    frames.publish(message)
    stop = threading.Event()

    def spin() -> None:
        while not stop.is_set():
            ros.executor.spin_once(timeout_sec=0.05)

    thread = threading.Thread(target=spin)
    thread.start()
    yield heard
    stop.set()
    thread.join()
    server.destroy()


def test_topics_are_listed_echoed_measured_and_published(heard: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    listed = ros2.topic_list()
    assert listed.data["topics"]["/ticks"] == "std_msgs/msg/String"
    echoed = ros2.echo("status", count=1)  # latched: it was published long before
    assert echoed.data["messages"] == [{"data": "ready"}]
    assert ros2.echo("steps", count=1).data["messages"] == [{"data": "down"}], "the newest of those that are kept"
    assert [step["data"] for step in ros2.echo("steps", count=2).data["messages"]] == ["along", "down"]
    assert "data: ready" in capsys.readouterr().out
    assert cli.run(["topic", "echo", "status", "-n", "1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["messages"] == [{"data": "ready"}], "JSON, and nothing else"
    measured = ros2.hz("/ticks", seconds=1.0).data
    assert measured["rate_hz"] > 0.0
    assert 0.0 <= measured["delay_median_ms"] <= measured["delay_max_ms"]
    assert ros2.pub("/talk", "{data: hello}", count=2, rate=20.0).success
    deadline = time.monotonic() + DEADLINE_S
    while len(heard) < 2 and time.monotonic() < deadline:
        threading.Event().wait(0.01)  # the node takes them in a thread of its own
    assert heard == ["hello", "hello"]
    alone = ros2.pub("/unheard", "std_msgs/msg/String")
    assert (alone.success, alone.code) == (False, Code.NOT_READY)


@pytest.mark.requirement("A-16")
def test_an_arm_moves_by_a_stream_of_commands(bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As docs/interfaces.md says: one command is held for half a second, a stream until it ends."""
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    joint, far = "openarm_right_joint4", 2.3
    fields = f"{{name: [{joint}], position: [{far}]}}"
    ended: list[bool] = []

    def publish(*words: str) -> int:
        code = cli.run(["topic", "pub", "/joint_commands", fields, *words])
        ended.append(True)
        return code

    with ThreadPoolExecutor() as threads:
        alone = threads.submit(publish, "--once")
        bench.ros.spin_until(lambda: ended, what="the end of one command")
        assert alone.result() == 0
        bench.spin_sim(0.7)
        assert bench.HOME[3] < bench.position(joint) < far - 0.1, "it stopped where the command ended"
        ended.clear()
        stream = threads.submit(publish, "--rate", "50", "--duration", "2")
        bench.ros.spin_until(lambda: ended, 60.0, "the end of the stream")
        assert stream.result() == 0
    assert bench.position(joint) == pytest.approx(far, abs=0.02)


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


def test_services_and_actions_are_called_and_the_exit_code_follows_the_answer(heard: list[str]) -> None:
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


def test_mistakes_are_met_with_a_suggestion(heard: list[str]) -> None:
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
        with pytest.raises(OpenArmError) as refused:
            command()
        assert refused.value.code == Code.INVALID_ARGUMENT
        assert said in refused.value.message


def test_without_nodes_every_command_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(peer_client, "_FIRST_NODE_S", 0.5)
    domain = os.environ["ROS_DOMAIN_ID"]
    for command in (["topic", "list"], ["service", "call", "/grasp"], ["tf", "tree"], ["param", "dump", "grasp"]):
        assert cli.run([*command, "--json"]) == 1
        answer = json.loads(capsys.readouterr().out)
        assert answer["code"] == Code.NOT_READY
        assert f"no node is discovered in domain {domain} " in answer["message"]
    bag = tmp_path / "bag"
    assert cli.run(["record", str(bag), "--duration", "0.2", "--json"]) == 1
    assert json.loads(capsys.readouterr().out)["code"] == Code.NOTHING_DETECTED
    assert not bag.exists(), "its name is free for the next try"


def test_nodes_and_parameters(heard: list[str]) -> None:
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


def test_nodes_say_how_they_are(ros, heard: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(listener, "_RATES_S", 0.5)
    monkeypatch.setattr(listener, "_LISTEN_S", DEADLINE_S)
    monkeypatch.setattr(listener, "_ready", lambda _: {"arm", "eye"})
    reports = ros.node.create_publisher(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    levels = {"arm: status": DiagnosticStatus.OK, "eye: status": DiagnosticStatus.ERROR}
    status = [DiagnosticStatus(name=name, level=level, message="as it is") for name, level in levels.items()]
    ros.node.create_timer(0.02, lambda: reports.publish(DiagnosticArray(status=status)))
    clock = ros.node.create_publisher(Clock, "/clock", 10)
    ros.node.create_timer(0.01, lambda: clock.publish(Clock()))
    outcome = ros2.health()
    assert (outcome.success, outcome.message) == (False, "eye: not well")
    assert outcome.data["diagnostics"] == {"arm": (True, "as it is"), "eye": (False, "as it is")}
    assert outcome.data["nodes"].count("probe") == 1
    assert outcome.data["rates"]["/clock"] > 0.0
    assert outcome.text.splitlines()[1].split() == ["eye", "error", "as", "it", "is"]


@pytest.mark.requirement("B-35")
def test_the_tree_of_frames_is_shown_and_drawn(heard: list[str], tmp_path: Path) -> None:
    out = tmp_path / "tree.png"
    tree = tf.tree(out=out)
    assert tree.text.splitlines() == ["world", "  base", "    camera"]
    assert cv2.imread(str(out)).shape[0] > 60
    assert tf.echo("world", "camera").data["position"] == [1.5, 0.0, 0.0]
    with pytest.raises(OpenArmError, match=r"ends in \.png, \.svg or \.pdf"):
        tf.tree(out=tmp_path / "tree.jpg")


def test_a_frame_with_two_publishers_is_named(ros, heard: list[str]) -> None:
    second = ros.node.create_publisher(TFMessage, "/tf_static", QOS_STATIC_TF)
    edge = TransformStamped(child_frame_id="camera")
    edge.header.frame_id = "world"
    second.publish(TFMessage(transforms=[edge]))
    tree = tf.tree()
    assert (tree.success, list(tree.data["clashes"])) == (False, ["camera"])
    assert "camera has the parents" in tree.message
