# SPDX-License-Identifier: Apache-2.0
"""Takes topics of a running graph as raw CDR: subscribes to them as they appear, and polls its readers.

Polling sixty readers takes 0.1 ms; an executor makes a new wait set of them for every few messages.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from rclpy.qos import LivelinessPolicy, QoSProfile
from rclpy.subscription import Subscription
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime

from openarm_bringup.bags.bag import Message, Topic
from openarm_bringup.bags.losses import Arrivals
from openarm_bringup.messages import interface
from openarm_common.camera.cameras import depth_cameras, hand_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.node import BaseNode, offered_qos
from openarm_common.ros.polled import Unspun

_ROBOT = "/joint_states|/tf|/tf_static|/clock|/robot_description"
_REQUESTS = r"/detections_2d|/detections_3d|/grasp/.*|/motion/.*|/.*/controller_state|/diagnostics|/sim/ground_truth/.*"
#: What the flight recorder keeps.
FLIGHT = (_ROBOT, r"/grasp/.*|/motion/.*|/diagnostics|/octomap_binary")
#: Not recorded by a profile: a replay would be taken for the simulation or for a parameter service.
_NEVER = r".*/_action/.*|/parameter_events|/rosout"
#: Periods of all cameras in which streams of a frame may be apart.
_PERIODS = 32
#: What rosbag2 writes for "no limit".
_NO_LIMIT = QosTime(9223372036, 854775807)


def _images() -> str:
    return rf"/({'|'.join(depth_cameras())})/(color|depth)/(image_raw|camera_info)"


def profiles() -> Mapping[str, tuple[str, ...]]:
    """Return what the profiles record: regular expressions of whole topic names."""
    camera = (_images(), _ROBOT)
    return {"camera": camera, "grasp": (*camera, _REQUESTS), "all": (".*",)}


def flight_on_demand() -> tuple[str, ...]:
    """Return what the flight recorder keeps while another node subscribes: made for subscribers only."""
    detections = rf"(/({'|'.join(hand_cameras())}))?/detections_[23]d"
    return (_images(), detections, r"/.*_controller/controller_state")


#: Given a message as CDR and what is known of it.
_Take = Callable[[bytes, Mapping[str, Any]], None]


class Listener:
    """Subscribes to the topics that match; nothing comes but by `discover` and `drain`.

    Args:
        node: Owns the readers; an executor that spins it leaves them alone.
        patterns: Regular expressions; a topic whose whole name matches one is taken, also when it comes later.
        put: Gets each topic before its first message, and each message.
        image_rate: Largest rate of each image stream, Hz of their stamps; 0 keeps all.
        depth: Messages that a reader keeps between two calls of `drain`.
        on_demand: Patterns of topics that are made for their subscribers: taken while another node does.

    Attributes:
        topics: Names of what is taken, or was.
        lost: Messages that were published and never came, by topic.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pattern that is none.
    """

    def __init__(
        self,
        node: BaseNode[Any],
        patterns: tuple[str, ...],
        put: Callable[[Topic | Message], None],
        *,
        image_rate: float = 0.0,
        depth: int = 200,
        on_demand: tuple[str, ...] = (),
    ) -> None:
        try:
            self._wanted, self._on_demand = ([re.compile(text) for text in group] for group in (patterns, on_demand))
        except re.error as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"a topic pattern is no regular expression: {error}") from error
        self._node = node
        self._put = put
        self._depth = depth
        self._thinner = Thinner(image_rate)
        self._group = Unspun()
        self._refused: set[str] = set()
        #: Types of the topics that are taken while another node does.
        self._followed: dict[str, str] = {}
        self._readers: dict[str, tuple[Subscription, _Take]] = {}
        self.topics: set[str] = set()
        self.lost = Counter[str]()

    @property
    def readers(self) -> list[Subscription]:
        """The subscriptions of the moment."""
        return [reader for reader, _ in self._readers.values()]

    def discover(self) -> None:
        """Find what has appeared, and subscribe to it."""
        for topic, kinds in self._node.get_topic_names_and_types():
            if topic in self._refused or topic in self._readers or re.fullmatch(_NEVER, topic):
                continue
            if any(pattern.fullmatch(topic) for pattern in self._wanted):
                if self._node.count_publishers(topic):
                    self._subscribe(topic, kinds[0])
            elif topic not in self._followed and any(pattern.fullmatch(topic) for pattern in self._on_demand):
                self._followed[topic] = kinds[0]
                self._node.take_images_at(0.0, [topic])

    def drain(self) -> None:
        """Take what has come; join who asks for a topic on demand, and leave with the last."""
        for topic in self._readers:
            self._drain(topic)
        for topic, kind in list(self._followed.items()):
            taken = topic in self._readers
            wanted = self._node.count_subscribers(topic) > taken
            if wanted and not taken:
                self._subscribe(topic, kind)
            elif taken and not wanted:
                self._node.destroy_subscription(self._readers.pop(topic)[0])

    def leave(self) -> None:
        """End all subscriptions; `discover` makes them again."""
        while self._readers:
            self._node.destroy_subscription(self._readers.popitem()[1][0])

    def _subscribe(self, topic: str, kind: str) -> None:
        try:
            message = interface(kind)
        except OpenArmError as error:
            self._refused.add(topic)
            self._followed.pop(topic, None)
            self._node.get_logger().warning(f"{topic} is not recorded: {error.message}")
            return
        profile = offered_qos(self._node, topic, self._depth)
        if topic not in self.topics:
            self.topics.add(topic)
            self._put(Topic(topic, kind, from_profile(profile)))
        reader = self._node.create_subscription(message, topic, _unused, profile, raw=True, callback_group=self._group)
        self._readers[topic] = reader, self._taker(topic)

    def _drain(self, topic: str) -> None:
        reader, take = self._readers[topic]
        with reader.handle:
            for _ in range(self._depth):
                if (message := reader.handle.take_message(reader.msg_type, True)) is None:
                    break
                take(*message)

    def _taker(self, topic: str) -> _Take:
        arrivals = Arrivals()

        def take(data: bytes, info: Mapping[str, Any]) -> None:
            missing = arrivals.missing(info["publication_sequence_number"], lambda: self._node.count_publishers(topic))
            if missing:
                self.lost[topic] += missing
            if self._thinner.keeps(topic, data):
                self._put(Message(topic, info["received_timestamp"], data))

        return take


def _unused(_: bytes) -> None:
    """The callback of a reader that is polled, not spun."""


class Thinner:
    """Keeps frames of the cameras at a lower rate: all streams of one stamp, and one message of each stream a period.

    A stream that begins in mid-period, as colour does when a detector wakes, is not left out until the next one.

    Args:
        rate: Hz of the stamps; 0 keeps all.
    """

    def __init__(self, rate: float) -> None:
        self._period_ns = round(1e9 / rate) if rate > 0.0 else 0
        #: Stamps and streams that were kept, by camera and period; of the newest periods.
        self._kept: dict[tuple[str, int], tuple[set[int], set[str]]] = {}

    def keeps(self, topic: str, data: bytes) -> bool:
        """Whether to keep a message. Stamps decide, so that colour and depth of a frame stay together."""
        if not self._period_ns or not topic.endswith(("/image_raw", "/camera_info", "/points")):
            return True
        stamp_ns = int.from_bytes(data[4:8], "little") * 1_000_000_000 + int.from_bytes(data[8:12], "little")
        stamps, streams = self._kept.setdefault((topic.split("/")[1], stamp_ns // self._period_ns), (set(), set()))
        if len(self._kept) > _PERIODS:
            del self._kept[next(iter(self._kept))]
        if stamp_ns not in stamps and topic in streams:
            return False
        stamps.add(stamp_ns)
        streams.add(topic)
        return True


def from_profile(profile: QoSProfile) -> Qos:
    """Return the profile as it is kept in a bag."""
    return Qos(
        history=QosHistory[profile.history.name],
        depth=profile.depth,
        reliability=QosReliability[profile.reliability.name],
        durability=QosDurability[profile.durability.name],
        deadline=_NO_LIMIT,
        lifespan=_NO_LIMIT,
        liveliness=QosLiveliness[LivelinessPolicy.AUTOMATIC.name],
        liveliness_lease_duration=_NO_LIMIT,
        avoid_ros_namespace_conventions=False,
    )
