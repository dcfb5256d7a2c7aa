# SPDX-License-Identifier: Apache-2.0
"""The probe of the supervisor and the observer of the demo, against real publishers and servers in this process."""

from __future__ import annotations

import itertools
import os
import threading
import time
from collections.abc import Callable, Iterator

import pytest
from openarm_interfaces.msg import GraspStatus, ObjectState, ObjectStateArray
from openarm_interfaces.srv import ResetWorld
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger

from openarm_bringup.supervision.graph import Ready
from openarm_bringup.supervision.ros.readiness import ReadinessClient
from openarm_common.errors import Code
from openarm_common.ros.convert import ns_to_stamp
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import Step
from tests.conftest import DEADLINE_S
from tests.refusals import refused

LATCHED = QoSProfile(depth=5, durability=DurabilityPolicy.TRANSIENT_LOCAL)


@pytest.fixture
def probe(ros) -> Iterator[ReadinessClient]:
    client = ReadinessClient({name: os.environ[name] for name in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE")})
    yield client
    client.close()


def until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, "not within the time"
        threading.Event().wait(0.02)


def test_probe_sees_topics_services_and_first_messages(ros, probe: ReadinessClient) -> None:
    conditions = (Ready(topic="/said"), Ready(service="/do"), Ready(message="/said"), Ready(message="/kept"))
    assert probe.unmet(conditions, frozenset()) == ("topic /said", "service /do", "message /said", "message /kept")
    publisher = ros.node.create_publisher(String, "/said", 1)
    kept = ros.node.create_publisher(String, "/kept", LATCHED)
    kept.publish(String(data="early"))
    ros.node.create_service(Trigger, "/do", lambda request, response: response)
    until(lambda: probe.unmet(conditions, frozenset()) == ("message /said",))

    def heard() -> bool:
        publisher.publish(String(data="now"))
        return probe.unmet(conditions, frozenset()) == ()

    until(heard)


def test_probe_distinguishes_a_new_server_from_the_one_before(ros, probe: ReadinessClient) -> None:
    conditions = (Ready(service="/do"),)
    first = ros.add(Node("first"))
    first.create_service(Trigger, "/do", lambda request, response: response)
    until(lambda: probe.unmet(conditions, frozenset()) == ())
    old = probe.known(conditions)
    assert len(old) == 1
    assert probe.unmet(conditions, old) == ("service /do",)
    ros.add(Node("second")).create_service(Trigger, "/do", lambda request, response: response)
    until(lambda: probe.unmet(conditions, old) == ())


def test_probe_lists_parameters_of_who_answers(ros, probe: ReadinessClient) -> None:
    node = ros.add(Node("arm"))
    node.declare_parameter("speed.max", 1.0)
    names: list[frozenset[str]] = []
    ros.spin_until(lambda: names.extend(filter(None, [probe.parameters("arm")])) or bool(names))
    assert "speed.max" in names[0]
    assert probe.parameters("absent") is None


class World:
    """A stand-in for bridge and grasp node: publishes truth at its own pace, answers resets."""

    def __init__(self, ros) -> None:
        self.node = ros.add(Node("world"))
        self.truth = self.node.create_publisher(ObjectStateArray, "/sim/ground_truth/objects", 10)
        self.status = self.node.create_publisher(GraspStatus, "/grasp/status", LATCHED)
        self.node.create_service(ResetWorld, "/sim/reset_world", self.reset)
        self.node.create_timer(0.02, self.tell)
        self.tick = 0

    def tell(self) -> None:
        self.tick += 1
        message = ObjectStateArray(objects=[ObjectState(name="cube", label="red")])
        message.header.stamp.nanosec = self.tick
        message.objects[0].pose.position.x = 0.5
        message.objects[0].pose.orientation.w = 1.0
        self.truth.publish(message)

    def reset(self, request: ResetWorld.Request, response: ResetWorld.Response) -> ResetWorld.Response:
        response.success = request.scene == "random"
        response.message = "" if response.success else "no such scene"
        return response


def test_observer_keeps_tracks_states_and_resets_the_world(ros) -> None:
    world = World(ros)
    world.status.publish(GraspStatus(state="IDLE", reason="waiting"))
    steps: list[Step] = []
    done = threading.Event()
    spinner = threading.Thread(target=lambda: ros.spin_until(done.is_set))
    spinner.start()
    try:
        with Observer(int(os.environ["ROS_DOMAIN_ID"]), steps.append) as observer:
            observer.wait(lambda: len(observer.track("cube")) >= 3 or None, DEADLINE_S, "truth")
            observer.wait(lambda: observer.steps() or None, DEADLINE_S, "the latched state")
            track = observer.track("cube")
            assert track[0].p_world[0] == 0.5
            assert all(a.t_ns < b.t_ns for a, b in itertools.pairwise(track))
            assert (steps[0].state, steps[0].reason) == ("IDLE", "waiting")
            assert observer.reset_world("random", 3) >= track[-1].t_ns
            assert refused("refused: no such scene", observer.reset_world, "nowhere", 0).code is Code.SCENE_INVALID
            observer.forget()
            assert observer.steps() == []
            now_ns = observer.truth().t_ns
            for state, t_ns in (("PLAN", 1), ("DETECT", now_ns + 10**9)):  # the first comes late, of a request before
                status = GraspStatus(state=state)
                status.header.stamp = ns_to_stamp(t_ns)
                world.status.publish(status)
            observer.wait(lambda: observer.steps() or None, DEADLINE_S, "a state")
            assert [step.state for step in observer.steps()] == ["DETECT"]
            refused(r"a unicorn was not there within 0.2 s", observer.wait, lambda: None, 0.2, "a unicorn")
    finally:
        done.set()
        spinner.join()
