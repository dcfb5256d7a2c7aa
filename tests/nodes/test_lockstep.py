# SPDX-License-Identifier: Apache-2.0
"""A node in lock-step, led by the test (N-18): what it handles at a tick, in which order, and what it answers."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest
import rclpy
from openarm_interfaces.msg import SimAck, SimChannel, SimTick
from rclpy.context import Context
from rclpy.executors import ExternalShutdownException
from rclpy.parameter import Parameter
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from openarm_common.config import Config
from openarm_common.ros.convert import ns_to_stamp
from openarm_common.ros.lockstep_executor import ParticipantExecutor
from openarm_common.ros.lockstep_node import ACK_TOPIC, QOS_TICK, TICK_TOPIC
from openarm_common.ros.node import QOS_COMMAND, QOS_SENSOR, BaseNode


class Nothing(Config):
    """No parameters."""


class Listener(BaseNode[Nothing]):
    """Writes down what it handles."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("listener", Nothing, **kwargs)
        self.log: list[str] = []
        for topic in ("/b", "/a"):
            self.create_subscription(JointState, topic, lambda m, topic=topic: self._on(topic, m), QOS_SENSOR)
        self._heard = self.create_publisher(JointState, "/heard", QOS_COMMAND)
        self._service = self.create_client(Trigger, "/ask")
        self.create_timer(0.025, lambda: self.log.append(f"timer {self.monotonic():.2f}"), clock=self.wall_clock)

    def _on(self, topic: str, message: JointState) -> None:
        self.log.append(f"{topic} {message.name[0]}")
        self._heard.publish(message)
        if message.name[0] == "ask":
            self.in_thread(self.log.append, "worked")
            self._service.call_async(Trigger.Request())


class Lead:
    """Leads the listener, which spins in a thread and a context of its own."""

    def __init__(self, ros: Any) -> None:
        self._ros = ros
        self._context = Context()
        rclpy.init(context=self._context, domain_id=ros.node.context.get_domain_id())
        self.node = Listener(
            context=self._context, parameter_overrides=[Parameter("lockstep", Parameter.Type.BOOL, True)]
        )
        self._executor = ParticipantExecutor(self.node)
        self._thread = threading.Thread(target=self._spin)
        self.acks: list[SimAck] = []
        self._ticks = ros.node.create_publisher(SimTick, TICK_TOPIC, QOS_TICK)
        ros.node.create_subscription(SimAck, ACK_TOPIC, self._on_ack, QOS_TICK)
        self._topics = {name: ros.node.create_publisher(JointState, name, QOS_COMMAND) for name in ("/a", "/b")}
        self.sent = {"/a": 0, "/b": 0}
        self._sequence = 0
        self._thread.start()
        publishers = (self._ticks, *self._topics.values())
        ros.spin_until(lambda: all(p.get_subscription_count() for p in publishers), what="the listener is connected")

    def _spin(self) -> None:
        try:
            self._executor.spin()
        except ExternalShutdownException:
            return

    def _on_ack(self, ack: SimAck) -> None:
        self.acks.append(ack)

    def send(self, topic: str, t_ns: int, name: str) -> None:
        message = JointState(name=[name])
        message.header.stamp = ns_to_stamp(t_ns)
        self._topics[topic].publish(message)
        self.sent[topic] += 1

    def begin_tick(self, t_ns: int, sent: dict[str, int] | None = None) -> int:
        self._sequence += 1
        channels = [SimChannel(name=name, sent=n, receivers=1) for name, n in (sent or self.sent).items()]
        self._ticks.publish(SimTick(sequence=self._sequence, stamp=ns_to_stamp(t_ns), channels=channels))
        return self._sequence

    def answered(self, sequence: int) -> dict[str, int]:
        def there() -> bool:
            return any(ack.sequence == sequence for ack in self.acks)

        self._ros.spin_until(there, what=f"an answer to tick {sequence}")
        return {item.name: item.sent for ack in self.acks if ack.sequence == sequence for item in ack.sends}

    def tick(self, t_ns: int) -> dict[str, int]:
        return self.answered(self.begin_tick(t_ns))

    def close(self) -> None:
        rclpy.try_shutdown(context=self._context)
        self._thread.join(5.0)
        self._executor.shutdown()
        self.node.close()
        self.node.destroy_node()


@pytest.fixture
def lead(ros: Any) -> Iterator[Lead]:
    leader = Lead(ros)
    try:
        yield leader
    finally:
        leader.close()


@pytest.mark.requirement("N-18")
def test_messages_are_handled_by_stamp_and_topic_and_not_before_their_tick(lead: Lead) -> None:
    lead.tick(0)
    lead.send("/b", 20_000_000, "b20")
    lead.send("/b", 10_000_000, "b10")
    lead.send("/a", 10_000_000, "a10")
    lead.tick(20_000_000)
    assert lead.node.log == ["/a a10", "/b b10", "/b b20"]
    lead.send("/a", 30_000_000, "early")
    assert lead.answered(lead.begin_tick(21_000_000, {"/a": 1, "/b": 2})) == {}
    assert lead.node.log == ["/a a10", "/b b10", "/b b20"]
    assert lead.tick(22_000_000) == {"/heard": 4}
    assert lead.node.log[-1] == "/a early"


@pytest.mark.requirement("N-18")
def test_a_tick_waits_for_what_was_sent_and_the_answer_says_what_was_sent(lead: Lead, ros: Any) -> None:
    lead.tick(0)
    late = lead.begin_tick(10_000_000, {"/a": 1, "/b": 0})
    for _ in range(5):
        ros.executor.spin_once(timeout_sec=0.05)
    assert not any(ack.sequence == late for ack in lead.acks)
    lead.send("/a", 5_000_000, "ask")
    assert lead.answered(late) == {"/heard": 1, "/ask/request": 1}
    assert lead.node.log == ["/a ask", "worked"]


@pytest.mark.requirement("N-18")
def test_timers_follow_simulated_time(lead: Lead) -> None:
    for t_ms in (0, 20, 40, 60):
        lead.tick(t_ms * 1_000_000)
    assert lead.node.log == ["timer 0.04", "timer 0.06"]


@pytest.mark.requirement("N-18")
def test_a_subscription_that_is_given_up_is_silent_and_comes_back_at_once(lead: Lead) -> None:
    lead.tick(0)
    (given_up,) = (s for s in lead.node.subscriptions if s.topic_name == "/a")
    lead.node.destroy_subscription(given_up)
    lead.send("/a", 1_000_000, "unheard")
    lead.tick(1_000_000)
    assert lead.node.log == []
    again = lead.node.create_subscription(JointState, "/a", lambda m: lead.node.log.append(m.name[0]), QOS_SENSOR)
    assert again is given_up
    lead.send("/a", 2_000_000, "heard")
    lead.tick(2_000_000)
    assert lead.node.log == ["heard"]


def test_participants_say_what_they_wait_for_before_they_begin(lead: Lead, ros: Any) -> None:
    def ask(*channels: SimChannel) -> SimAck:
        lead.acks.clear()
        lead._ticks.publish(SimTick(channels=channels))
        ros.spin_until(lambda: lead.acks, what="an answer")
        return lead.acks[-1]

    first = ask()
    assert first.missing == "the other participants"
    assert {"/a", "/b", "/ask/response"} <= set(first.receives)
    assert {"/heard", "/ask/request"} <= {item.name for item in first.sends}
    unconnected = ask(SimChannel(name="/heard", receivers=1), SimChannel(name="/ask/request", receivers=1))
    assert unconnected.missing == "listeners of /heard, service /ask"
    assert ask(SimChannel(name="/a", sent=0, receivers=1)).missing == ""
