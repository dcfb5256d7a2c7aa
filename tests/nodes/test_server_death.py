# SPDX-License-Identifier: Apache-2.0
"""A node is killed while a goal runs: clients of a server notice, and the trajectory of a client ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor

import pytest
from control_msgs.action import FollowJointTrajectory
from std_srvs.srv import Trigger

from openarm_bringup.supervision.ros.readiness import ReadinessClient
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros import actions
from openarm_common.ros.actions import ActionClient
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import BaseNode
from openarm_grasp.config import GraspConfig
from openarm_grasp.ros.graph_clients import GraphClients
from tests.refusals import refused

NAME = "/wait"
#: An arm that comes to rest at once is never further from there, rad.
RINGING = 0.02
#: A node whose goals never end.
SERVER = """
import rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.task import Future
from openarm_common.ros.actions import ActionServer

async def wait(handle):
    handle.publish_feedback(FollowJointTrajectory.Feedback())
    await Future()

rclpy.init()
node = rclpy.create_node("waiter")
server = ActionServer(node, FollowJointTrajectory, "/wait", wait)
rclpy.spin(node)
"""
#: A node of the suite whose service never answers.
SERVICE = """
import rclpy
from rclpy.task import Future
from std_srvs.srv import Trigger
from openarm_common.config import Config
from openarm_common.ros.node import BaseNode

async def wait(request, response):
    await Future()

rclpy.init()
node = BaseNode("waiter", Config)
node.create_service(Trigger, "/wait", wait)
rclpy.spin(node)
"""
#: A client that sends the goal of its arguments as the motion node does.
OWNER = """
import os, sys
import numpy as np
import rclpy
from unique_identifier_msgs.msg import UUID
from openarm_common.config import Config
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import BaseNode
from openarm_motion.config import ExecutionConfig
from openarm_motion.ros.robot import Controller
from openarm_motion.timing.trajectory import Trajectory

rclpy.init()
node = BaseNode("owner", Config)
executor = rclpy.executors.SingleThreadedExecutor()
executor.add_node(node)
goal_id = lambda: UUID(uuid=list(os.urandom(16)))
name = "/right_joint_trajectory_controller/follow_joint_trajectory"
controller = Controller(node, name, ExecutionConfig(), goal_id)
here, there = (np.array([float(x) for x in part.split(",")]) for part in sys.argv[1:])
names = tuple(f"openarm_right_joint{i}" for i in range(1, 8))
t = np.array([0.0, 0.3, 5.7, 6.0])
speed = (there - here) / 5.7
q = np.array([here, here + 0.15 * speed, there - 0.15 * speed, there])
v = np.array([0.0 * speed, speed, speed, 0.0 * speed])
while not controller.ready():
    executor.spin_once(timeout_sec=0.1)
goal = controller.start(Trajectory(names, t, q, v, 0.0 * v), 0, touches=True)
executor.spin()
"""


class Children:
    """Processes of a test."""

    def __init__(self) -> None:
        self._all: list[subprocess.Popen[bytes]] = []

    def start(self, source: str, *arguments: str) -> subprocess.Popen[bytes]:
        self._all.append(subprocess.Popen([sys.executable, "-c", source, *arguments]))
        return self._all[-1]

    def end(self) -> None:
        for child in self._all:
            child.kill()
            child.wait()


@pytest.fixture
def children() -> Iterator[Children]:
    made = Children()
    yield made
    made.end()


def begun(pool: ThreadPoolExecutor, client: BackgroundNode) -> Future:
    """Send a goal, and wait until it runs."""
    running, goal = threading.Event(), FollowJointTrajectory.Goal()
    work = pool.submit(client.do, FollowJointTrajectory, NAME, goal, timeout=120.0, on_feedback=lambda _: running.set())
    assert running.wait(120.0)
    return work


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Who has stopped is not dead before a test has looked at it."""
    monkeypatch.setattr(actions, "_SILENT_S", 60.0)


@pytest.mark.long
@pytest.mark.requirement("R-21")
def test_a_client_ends_when_its_server_is_stopped_or_killed_and_works_with_the_next(ros, children) -> None:
    with ThreadPoolExecutor() as pool, BackgroundNode("client") as client:
        for number in (signal.SIGSTOP, signal.SIGKILL):
            server = children.start(SERVER)  # the one before is still in discovery, and does not answer
            work = begun(pool, client)
            ros.spin_until(lambda: "waiter" in client._node.get_node_names(), what="the name of the node")
            server.send_signal(number)
            assert refused("/wait: the node waiter is gone", work.result, 60.0).code is Code.NOT_READY


@pytest.mark.long
@pytest.mark.requirement("R-21")
def test_a_server_that_halts_for_a_while_is_not_dead_and_one_that_is_killed_then_is(ros, children, patient) -> None:
    with ThreadPoolExecutor() as pool, BackgroundNode("client") as client:
        server = children.start(SERVER)
        work = begun(pool, client)
        watched = client._clients[NAME]._watch
        server.send_signal(signal.SIGSTOP)
        ros.spin_until(lambda: watched.silence > 2.0, what="silence")
        assert not work.done()
        server.send_signal(signal.SIGCONT)
        ros.spin_until(lambda: watched.silence < 1.0, what="a sign of life again")
        assert not work.done()
        server.kill()
        refused(r"/wait: the .* is gone", work.result, 60.0)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("R-21")
def test_a_client_notices_the_death_of_its_server_within_two_seconds(children) -> None:
    with ThreadPoolExecutor() as pool, BackgroundNode("client") as client:
        server = children.start(SERVER)
        work = begun(pool, client)
        server.kill()
        killed = time.monotonic()
        refused("is gone", work.result, 60.0)
        assert time.monotonic() - killed < 2.0


@pytest.mark.long
def test_the_probe_of_a_supervisor_knows_who_is_silent(ros, children) -> None:
    environ = {name: os.environ[name] for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")}
    with ReadinessClient(environ) as probe:
        one, _ = (children.start(SERVICE.replace("waiter", name)) for name in ("one", "two"))
        ros.spin_until(lambda: {"one", "two"} <= set(probe._node.get_node_names()), what="two nodes")
        one.send_signal(signal.SIGSTOP)
        ros.spin_until(lambda: probe.silence("one") > 2.0 > probe.silence("two"), what="the silence of the first")
        one.send_signal(signal.SIGCONT)
        ros.spin_until(lambda: probe.silence("one") < 1.0, what="a sign of life again")
        one.kill()
        ros.spin_until(lambda: probe.silence("one") == 0.0, what="its end, which is no silence")


@pytest.mark.requirement("R-21")
@pytest.mark.parametrize(
    "undiscovered",
    [pytest.param(0, id="discovered"), pytest.param(3, id="node_discovered_after_its_service", marks=pytest.mark.long)],
)
def test_a_call_of_a_service_ends_when_its_node_is_killed(ros, children, undiscovered: int) -> None:
    with ThreadPoolExecutor() as pool, BackgroundNode("client", timeout=120.0) as client:
        nothing_yet, servers = iter(range(undiscovered)), client.servers
        client.servers = lambda service: [] if next(nothing_yet, None) is not None else servers(service)
        server = children.start(SERVICE)
        work = pool.submit(client.call, Trigger, NAME, Trigger.Request(), 60.0)
        ros.spin_until(
            lambda: any(watch._lives() for watch in client._watches.values()), 120.0, "a call to a node that lives"
        )
        server.kill()
        assert refused("/wait: the node waiter is gone", work.result, 60.0).code is Code.NOT_READY
        assert not client._clients[NAME]._pending_requests, "what has no answer is no longer waited for"


@pytest.mark.long
@pytest.mark.requirement("R-21")
def test_a_grasp_ends_when_a_node_that_it_waits_for_is_killed(ros, children) -> None:
    node = ros.add(BaseNode("grasp", Config))
    clients = GraphClients(node, GraspConfig(), 0.4)
    clients._silence.check = lambda _: None  # there is no robot
    clients._timer.reset()
    client = ActionClient(node, FollowJointTrajectory, NAME)
    server = children.start(SERVER)
    ros.spin_until(lambda: client.server_is_ready() and client._watch._lives(), what="the server, known to live")
    ros.spin_until(lambda: "waiter" in node.get_node_names(), what="the name of the node")
    errors: list[OpenArmError] = []

    async def transfer() -> None:
        try:
            await clients.goal(client, FollowJointTrajectory.Goal(), 60.0, "right arm: transfer")
        except OpenArmError as error:
            errors.append(error)

    ros.executor.create_task(transfer)
    ros.spin_until(lambda: client._goal_handles, what="a goal that runs")
    server.kill()
    ros.spin_until(lambda: errors, what="the end")
    assert errors[0].code is Code.ROBOT_LOST
    assert "right arm: transfer: the node waiter is gone" in errors[0].message
    assert not client.server_is_ready()
    client.destroy()


def holds_after(bridge, children, number: signal.Signals) -> float:
    """End or stop the process that sent a trajectory; return the time until the arm rests on its way, s."""
    bench = bridge(images=False, speed=1.0)
    there = [bench.HOME[0] + 2.0, *bench.HOME[1:]]
    owner = children.start(OWNER, ",".join(map(str, bench.arm)), ",".join(map(str, there)))
    column = bench.joints[-1].name.index(bench.ARM[0])
    bench.ros.spin_until(lambda: bench.joints[-1].velocity[column] > 0.25, 120.0, "the arm to move")
    bench.spin_sim(0.3)
    owner.send_signal(number)
    killed_ns = bench.node._simulation.robot.state.t_ns
    rests = lambda: abs(bench.joints[-1].velocity[column]) < 0.01  # noqa: E731
    bench.ros.spin_until(rests, what="the arm to rest")
    bench.spin_sim(0.5)
    after = [m for m in bench.joints if stamp_to_ns(m.header.stamp) > killed_ns]
    place = after[-1].position[column]
    assert place < there[0] - 0.3, "it does not arrive"
    moving = [stamp_to_ns(m.header.stamp) for m in after if abs(m.position[column] - place) > RINGING]
    return (max(moving, default=killed_ns) - killed_ns) * 1e-9


@pytest.mark.long
@pytest.mark.requirement("R-21")
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP])
def test_an_arm_holds_when_the_process_ends_or_hangs_that_sent_its_trajectory(bridge, children, number) -> None:
    holds_after(bridge, children, number)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("R-21")
def test_an_arm_holds_at_once_when_the_process_is_killed_that_sent_its_trajectory(bridge, children) -> None:
    assert holds_after(bridge, children, signal.SIGKILL) <= 0.2
