# SPDX-License-Identifier: Apache-2.0
"""Records topics of a running graph into a bag, as raw CDR.

Messages are taken in one thread and written in another, with a bounded queue between them. What does not fit is
counted as lost, and so is what never arrived, by the sequence numbers of the publishers.
"""

from __future__ import annotations

import os
import queue
import re
import shutil
import threading
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.losses import Arrivals
from openarm_bringup.messages import interface
from openarm_bringup.supervision.discovery import PROFILE
from openarm_bringup.supervision.environment import profiled
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_common.ros.client import ContextNode
from openarm_common.ros.node import offered_qos

#: What the profiles record: regular expressions of whole topic names.
_CAMERA = (
    r"/(overhead|wrist)/(color|depth)/(image_raw|camera_info)",
    "/joint_states|/tf|/tf_static|/clock|/robot_description",
)
PROFILES: Mapping[str, tuple[str, ...]] = {
    "camera": _CAMERA,
    "grasp": (
        *_CAMERA,
        r"/detections_2d|/detections_3d|/grasp/.*|/motion/.*|/.*/controller_state|/diagnostics|/sim/ground_truth/.*",
    ),
    "all": (".*",),
}
#: Not recorded by a profile: a replay would be taken for the simulation or for a parameter service.
_NEVER = r".*/_action/.*|/parameter_events|/rosout"
_QUEUE_BYTES, _LARGE = 512 * 2**20, 64 * 2**10
#: More than this waiting to be written: the disk gets it uncompressed, three times as fast.
_BEHIND_BYTES = 32 * 2**20
_DISCOVERY_S = 0.5
_LOOK_S = 0.005
#: Discovery is complete after this long without a change, s: a participant announces itself every three seconds. On
#: discovery Fast DDS opens its port in shared memory and, if no process reads there just then, sleeps a third of a
#: second with a lock that readers of other topics need: images that arrive meanwhile are lost. So all participants are
#: discovered first, and then recorded.
_KNOWN_S, _LONGEST_S = 3.2, 12.0
#: Messages that a reader keeps between two reads.
_DEPTH = 200
#: Given a message as CDR and what is known of it.
Take = Callable[[bytes, Mapping[str, Any]], None]
#: This much of the disk is left free, so that the bag can still be closed.
_SPARE_BYTES = 200 * 2**20
#: What rosbag2 writes for "no limit".
_NEVER_S = QosTime(9223372036, 854775807)


@dataclass
class Recorded:
    """What a recording holds, while it grows.

    Attributes:
        counts: Messages written, by topic.
        lost: Messages that were published but are not in the bag, by topic: they never came, or were not written.
        bytes: Written, before compression.
        ended: Why it ended; empty while it runs.
    """

    counts: Counter[str] = field(default_factory=Counter[str])
    lost: Counter[str] = field(default_factory=Counter[str])
    bytes: int = 0
    ended: str = ""


class _Topic(NamedTuple):
    name: str
    type: str
    qos: Qos


class _Message(NamedTuple):
    topic: str
    t_ns: int
    data: bytes


class Recorder(ContextNode):
    """Records until `stop`; a context manager.

    Args:
        domain: ROS_DOMAIN_ID of the graph.
        path: Folder of the bag.
        patterns: Regular expressions; a topic whose whole name matches one is recorded, also when it comes later.
        custom: Kept in the metadata.
        image_rate: Of each image stream, at most, Hz of their stamps; 0 keeps all.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pattern that is none or a folder that exists.
    """

    def __init__(
        self, domain: int, path: Path, patterns: tuple[str, ...], custom: Mapping[str, str], image_rate: float = 0.0
    ) -> None:
        try:
            self._wanted = [re.compile(pattern) for pattern in patterns]
        except re.error as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"a topic pattern is no regular expression: {error}") from error
        self.recorded = Recorded()
        self._path = path
        self._bag = BagWriter(path, custom)
        self._thinner = Thinner(image_rate)
        # Only the writing thread touches the bag: topics reach it through the queue as messages do.
        self._queue: queue.SimpleQueue[_Topic | _Message | None] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0  # each counted by one thread
        self._topics: set[str] = set()
        self._readers: list[tuple[Subscription, Take]] = []
        profile = os.environ.get(PROFILE) or config_dir() / "fastdds_recorder.xml"  # a user's own comes first
        with profiled(Path(profile)):
            super().__init__("openarm_recorder", domain=domain)
        self._end = threading.Event()
        self._began = threading.Event()
        self._changed = threading.Condition()
        self._threads = [
            threading.Thread(target=self._listen, name="recorder", daemon=True),
            threading.Thread(target=self._write, name="bag", daemon=True),
        ]

    def __enter__(self) -> Recorder:
        self._bag.__enter__()
        for thread in self._threads:
            thread.start()
        return self

    def close(self) -> None:
        """End the recording and close the bag."""
        self._end.set()
        self._threads[0].join()
        self._queue.put(None)
        self._threads[1].join()
        super().close()
        full = OSError(self.recorded.ended) if self.recorded.ended else None
        self._bag.remember("lost", str(self.recorded.lost.total()))
        self._bag.__exit__(type(full) if full else None, full, None)

    @property
    def topics(self) -> list[str]:
        """What is recorded, sorted."""
        return sorted(self._topics)

    def wait_began(self, seconds: float) -> bool:
        """Wait until discovery is complete and it records, at most for a time, s; return whether it does."""
        return self._began.wait(seconds)

    def wait(self, seconds: float) -> bool:
        """Wait for a time, s, at most until the recording ends early; return whether it goes on."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self.recorded.ended), seconds)
        return not self.recorded.ended

    def _await_discovery(self) -> None:
        """Wait until discovery is complete."""
        began = changed_at = time.monotonic()
        met: object = None
        while not self._end.wait(0.05):
            topics = self._node.get_topic_names_and_types()
            present = self._node.get_node_names(), [(topic, self._node.count_publishers(topic)) for topic, _ in topics]
            now = time.monotonic()
            if present != met:
                met, changed_at = present, now
            if now - changed_at > _KNOWN_S or now - began > _LONGEST_S:
                break

    def _listen(self) -> None:
        self._await_discovery()
        self._discover()
        self._began.set()
        # Polling sixty readers takes 0.1 ms; an executor makes a new wait set of them for every few messages.
        found_at = time.monotonic()
        while not self._end.wait(_LOOK_S):
            if time.monotonic() - found_at > _DISCOVERY_S:
                self._discover()
                found_at = time.monotonic()
            self._drain()
        self._drain()  # what has come until the end

    def _drain(self) -> None:
        for reader, take in self._readers:
            with reader.handle:
                for _ in range(_DEPTH):
                    if (message := reader.handle.take_message(reader.msg_type, True)) is None:
                        break
                    take(*message)

    def _discover(self) -> None:
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in self._topics or re.fullmatch(_NEVER, topic):
                continue
            if not any(pattern.fullmatch(topic) for pattern in self._wanted):
                continue
            if not self._node.count_publishers(topic):
                continue
            self._topics.add(topic)
            try:
                kind = interface(kinds[0])
            except OpenArmError as error:
                self._node.get_logger().warning(f"{topic} is not recorded: {error.message}")
                continue
            profile = offered_qos(self._node, topic, _DEPTH)
            self._queue.put(_Topic(topic, kinds[0], from_profile(profile)))
            reader = self._node.create_subscription(kind, topic, _unused, profile, raw=True)
            self._readers.append((reader, self._taker(topic)))

    def _taker(self, topic: str) -> Take:
        arrivals = Arrivals()

        def publishers() -> int:
            return self._node.count_publishers(topic)

        def take(data: bytes, info: Mapping[str, Any]) -> None:
            if missing := arrivals.missing(info["publication_sequence_number"], publishers):
                self.recorded.lost[topic] += missing
            if not self._thinner.keeps(topic, data):
                return
            # Where the disk can't keep up, large messages are dropped first.
            limit = _QUEUE_BYTES if len(data) > _LARGE else 2 * _QUEUE_BYTES
            if self._bytes_in - self._bytes_out > limit or self.recorded.ended:
                self.recorded.lost[topic] += 1
                return
            self._bytes_in += len(data)
            self._queue.put(_Message(topic, info["received_timestamp"], data))

        return take

    def _write(self) -> None:
        checked = 0
        while (item := self._queue.get()) is not None:
            if isinstance(item, _Topic):
                self._bag.add_topic(item.name, item.type, item.qos)
                continue
            topic, t_ns, data = item
            self._bytes_out += len(data)
            if self.recorded.ended:
                self.recorded.lost[topic] += 1
                continue
            try:
                if self.recorded.bytes >= checked:
                    free = shutil.disk_usage(self._path).free
                    if free < _SPARE_BYTES:
                        raise OSError(f"the disk has only {free // 2**20} MiB left")
                    checked = self.recorded.bytes + _SPARE_BYTES // 8
                self._bag.hasten(self._bytes_in - self._bytes_out > _BEHIND_BYTES)
                self._bag.write(topic, t_ns, data)
            except OSError as error:
                with self._changed:
                    self.recorded.ended = str(error)
                    self._changed.notify_all()
                self.recorded.lost[topic] += 1
                continue
            self.recorded.counts[topic] += 1
            self.recorded.bytes += len(data)


def _unused(_: bytes) -> None:
    """The callback of a reader that is polled, not spun."""


class Thinner:
    """Keeps whole frames of the cameras at a lower rate: all streams of one stamp, or none.

    Args:
        rate: Hz of the stamps; 0 keeps all.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = round(1e9 / rate) if rate > 0.0 else 0

    def keeps(self, topic: str, data: bytes) -> bool:
        """Whether to keep a message. Stamps decide, so that colour and depth of a frame stay together."""
        if not self._period_ns or not topic.endswith(("/image_raw", "/camera_info", "/points")):
            return True
        sec, nanosec = int.from_bytes(data[4:8], "little"), int.from_bytes(data[8:12], "little")
        # The frame that is nearest to a multiple of the period, of cameras with 30 Hz.
        return (sec * 1_000_000_000 + nanosec + 5_000_000) % self._period_ns < 33_333_333


def from_profile(profile: QoSProfile) -> Qos:
    """Return the profile as it is kept in a bag."""
    return Qos(
        history=QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=_NEVER_S,
        lifespan=_NEVER_S,
        liveliness=QosLiveliness[LivelinessPolicy.AUTOMATIC.name],
        liveliness_lease_duration=_NEVER_S,
        avoid_ros_namespace_conventions=False,
    )
