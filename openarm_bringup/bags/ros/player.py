# SPDX-License-Identifier: Apache-2.0
"""Publishes the messages of a bag as raw CDR."""

from __future__ import annotations

import re
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import ExternalShutdownException
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.validate_full_topic_name import validate_full_topic_name
from rosbags.interfaces import Qos, QosDurability, QosReliability
from rosgraph_msgs.msg import Clock

from openarm_bringup.bags.bag import Bag, Record, listed
from openarm_bringup.bags.ros.messages import no_message
from openarm_bringup.messages import interface
from openarm_bringup.supervision.environment import profiled, write_profile
from openarm_bringup.supervision.graph import NodeSpec
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.actions import RCLError
from openarm_common.ros.client import ContextNode
from openarm_common.ros.convert import ns_to_stamp

_CLOCK = "/clock"
#: What comes from a robot and its cameras: two of them in one graph would be taken for one that jumps.
_ROBOT = r"/clock|/joint_states|/tf|.*/(color|depth)/(image_raw|camera_info)"
#: Topics that several may publish.
_SHARED = "/tf_static"
#: Subscribers of what a graph publishes come within this time after the publishers are there, s.
_MEET_S = 4.0
_SETTLE_S = 1.0


class Player(ContextNode):
    """Publishers for the topics of a bag; a context manager.

    Args:
        bag: Open.
        topics: Only these; None takes all that can be published.
        names: New names of topics.
        clock: Publish /clock from the bag's stamps when it holds none.

    Attributes:
        published: Messages so far.
        left_out: Why topics are left out: their encoding, name or type; subscribers would misread other fields.
        left: Topics that the graph publishes itself, and that are left to it.
        late_ms: The most that a message was published after its time.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a topic that is asked for can't be published.
    """

    def __init__(self, bag: Bag, topics: Sequence[str] | None, names: Mapping[str, str], *, clock: bool) -> None:
        self.published = 0
        self.late_ms = 0.0
        self._bag = bag
        asked = [topic for topic in bag.topics if topics is None or topic in topics]
        refused = {topic: why for topic in asked if (why := _why_not(bag, topic, names.get(topic, topic)))}
        if topics is not None and refused:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{bag.path} can't be replayed: {listed(refused)}")
        self.left_out = {**bag.left_out, **refused}
        self._folder = tempfile.TemporaryDirectory()
        spec = NodeSpec(module="openarm_bringup", large_messages=True, segment_mib=24)
        profile = write_profile(spec, Path(self._folder.name) / "fastdds.xml")
        with profiled(profile):
            super().__init__("openarm_player")
        self._publishers: dict[str, Publisher] = {}
        for topic in asked:
            if topic not in self.left_out:
                kind, qos = bag.topics[topic]
                name = names.get(topic, topic)
                self._publishers[topic] = self._node.create_publisher(interface(kind), name, to_profile(qos))
        self.left: list[str] = []
        self._all = topics is None
        own_clock = clock and _CLOCK not in self._publishers
        self._clock = self._node.create_publisher(Clock, _CLOCK, 1) if own_clock else None

    def __enter__(self) -> Player:
        # A subscriber discovers a publisher a little later than the publisher discovers it; there is no event for that.
        began = changed = time.monotonic()
        before: list[int] = []
        while (now := time.monotonic()) - began < _MEET_S:
            counts = [publisher.get_subscription_count() for publisher in self._publishers.values()]
            if counts != before:
                before, changed = counts, now
            if all(counts) and now - changed > _SETTLE_S:
                break
            time.sleep(0.02)
        try:
            if self._all:
                self._yield_to_graph()
        except OpenArmError:
            self.close()
            raise
        return self

    def _yield_to_graph(self) -> None:
        """Leave out the topics that other nodes publish already.

        Raises:
            OpenArmError: BUSY, when a robot publishes them.
        """
        for topic, publisher in list(self._publishers.items()):
            name = publisher.topic_name
            infos = self._node.get_publishers_info_by_topic(name)
            others = sorted({info.node_name for info in infos} - {self._node.get_name()})
            if not others or name == _SHARED:
                continue
            if re.fullmatch(_ROBOT, name):
                raise OpenArmError(
                    Code.BUSY,
                    f"{name} is published by {', '.join(others)} already, and a bag takes the place of the robot; "
                    "replay into a graph without one (`openarm up replay`), or choose topics (--topics, --remap)",
                )
            self.left.append(name)
            self._node.destroy_publisher(self._publishers.pop(topic))

    def close(self) -> None:
        """Leave the graph."""
        super().close()
        self._folder.cleanup()

    def play(self, rate: float, start: float, duration: float, stop: threading.Event) -> None:
        """Publish from `start` seconds on, for `duration` seconds of the bag (0: to its end).

        Args:
            rate: Times real time. With 0, each message waits only until reliable subscribers have taken the last.
            start: Start in the bag, s.
            duration: Duration in the bag, s.
            stop: Ends it early.
        """
        first = self._bag.start_ns + round(start * 1e9)
        last = first + round(duration * 1e9) if duration else None
        self._latch(first if start else None)
        began: int | None = None
        for record in self._bag.records(list(self._publishers), start):
            if stop.is_set() or (last is not None and record.t_ns > last):
                return
            if rate > 0.0:
                now = time.monotonic_ns()
                began = now - round((record.t_ns - first) / rate) if began is None else began
                due = began + round((record.t_ns - first) / rate)
                if due > now and stop.wait((due - now) * 1e-9):
                    return
                self.late_ms = max(self.late_ms, (time.monotonic_ns() - due) * 1e-6)
            self._publish(record)
            if rate == 0.0:
                self._publishers[record.topic].wait_for_all_acked()

    def _latch(self, before: int | None) -> None:
        """Publish the last message of each latched topic from before the start."""
        if before is None:
            return
        latched = [
            topic
            for topic in self._publishers
            if to_profile(self._bag.topics[topic][1]).durability == DurabilityPolicy.TRANSIENT_LOCAL
        ]
        newest: dict[str, Record] = {}
        for record in self._bag.records(latched):
            if record.t_ns >= before:
                break
            newest[record.topic] = record
        for record in newest.values():
            self._publish(record)

    def _publish(self, record: Record) -> None:
        if self._clock is not None:
            self._clock.publish(Clock(clock=ns_to_stamp(record.t_ns)))
        try:
            self._publishers[record.topic].publish(record.data)
        except RCLError as error:
            raise no_message(self._bag, record) from error
        self.published += 1

    def wait_idle(self, quiet_s: float, limit_s: float) -> None:
        """Wait until no other node of the graph has published anything for `quiet_s` seconds.

        Raises:
            OpenArmError: TIMEOUT, naming a topic that goes on after `limit_s` seconds.
        """
        heard = {"": time.monotonic()}
        own = {publisher.topic_name for publisher in self._publishers.values()}
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in own or re.fullmatch(r"/rosout|/parameter_events|/diagnostics|/clock", topic):
                continue

            def note(_: bytes, topic: str = topic) -> None:
                heard[topic] = time.monotonic()

            try:
                kind = interface(kinds[0])
            except OpenArmError:
                continue
            profile = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
            self._node.create_subscription(kind, topic, note, profile, raw=True)
        limit = time.monotonic() + limit_s
        with suppress(ExternalShutdownException):  # the end of the process
            while (now := time.monotonic()) - max(heard.values()) < quiet_s:
                if now > limit:
                    topic = max(heard, key=lambda key: heard[key])
                    raise OpenArmError(Code.TIMEOUT, f"{topic} is still published {limit_s:g} s after the bag's end")
                self._executor.spin_once(timeout_sec=0.1)


def _why_not(bag: Bag, topic: str, name: str) -> str:
    """Return why the messages of a topic can't be published under a name; empty when they can."""
    kind, _ = bag.topics[topic]
    try:
        validate_full_topic_name(name if name.startswith("/") else f"/{name}")
        interface(kind)
        return bag.why_not(topic)
    except OpenArmError as error:
        return f"{kind} can't be published: {error.message}"
    except InvalidTopicNameException:
        return "this is no name of a topic in ROS 2; give another by --remap FROM:=TO"


def to_profile(qos: Qos | None) -> QoSProfile:
    """Return a profile to publish with; reliable and volatile where a bag says nothing."""
    reliable = qos is None or qos.reliability != QosReliability.BEST_EFFORT
    latched = qos is not None and qos.durability == QosDurability.TRANSIENT_LOCAL
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(qos.depth, 10) if qos is not None else 10,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )
