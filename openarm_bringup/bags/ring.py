# SPDX-License-Identifier: Apache-2.0
"""The newest messages of a graph, compressed in memory, within a time and a number of bytes."""

from __future__ import annotations

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from rosbags.interfaces import QosDurability
from rosbags.rosbag2.storage_mcap import zstd

from openarm_bringup.bags.bag import Message, Topic

#: Smaller messages are kept as they are.
_LARGE = 4096
#: What a message takes besides its data, bytes.
_OVERHEAD = 300
#: Begins a frame of zstd; CDR begins with 0.
_PACKED = b"\x28"
#: Messages that are kept of a latched topic that several publish, such as /tf_static.
_SHARED = 64


@dataclass(frozen=True)
class Moment:
    """What a ring held at a time.

    Attributes:
        topics: Topics of the messages.
        seconds: Time from the first message to the last, s.
        packed: The messages in the order of their stamps, large ones compressed.
    """

    topics: Sequence[Topic]
    seconds: float
    packed: Sequence[Message]

    def messages(self) -> Iterator[Message]:
        """The messages as they were received; those that were latched before are first, with the first stamp."""
        for message in self.packed:
            data = message.data
            yield message._replace(data=zstd.decompress(data)) if data[:1] == _PACKED else message


class Ring:
    """Keeps messages until they are too old or too much; of what is latched, also what a late subscriber would get.

    Args:
        seconds: Longest age of a message, s.
        limit: Bytes that the messages take in memory, at most.
        publishers: Number of publishers that a topic has now.
    """

    def __init__(self, seconds: float, limit: int, publishers: Callable[[str], int]) -> None:
        self._length_ns, self._limit, self._publishers_of = round(seconds * 1e9), limit, publishers
        self._topics: dict[str, Topic] = {}
        self._messages: deque[Message] = deque()
        #: Contents of latched topics that had to give way, each once, the newest last.
        self._latched: defaultdict[str, dict[bytes, None]] = defaultdict(dict)
        self._publishers = Counter[str]()
        self._newest_ns = 0
        self.bytes = 0

    @property
    def seconds(self) -> float:
        """From the first message to the newest, s."""
        return 1e-9 * (self._newest_ns - self._messages[0].t_ns) if self._messages else 0.0

    def put(self, item: Topic | Message) -> None:
        """Take a topic, or a message of a topic."""
        if isinstance(item, Topic):
            self._topics[item.name] = item
            return
        if len(item.data) >= _LARGE:
            item = item._replace(data=zstd.compress(item.data, 1))
        self._messages.append(item)
        self.bytes += len(item.data) + _OVERHEAD
        self._newest_ns = max(self._newest_ns, item.t_ns)
        while self.bytes > self._limit or self._messages[0].t_ns < self._newest_ns - self._length_ns:
            self._drop()

    def _drop(self) -> None:
        topic, _, data = self._messages.popleft()
        self.bytes -= len(data) + _OVERHEAD
        if self._topics[topic].qos.durability != QosDurability.TRANSIENT_LOCAL:
            return
        kept = self._latched[topic]
        kept.pop(data, None)
        kept[data] = None
        self._publishers[topic] = max(self._publishers[topic], self._publishers_of(topic))
        while len(kept) > (_SHARED if self._publishers[topic] > 1 else 1):
            del kept[next(iter(kept))]

    def clear(self) -> None:
        """Forget all messages."""
        self._messages.clear()
        self._latched.clear()
        self.bytes = self._newest_ns = 0

    def moment(self) -> Moment:
        """Return what is kept now."""
        recent = sorted(self._messages, key=lambda message: message.t_ns)
        first_ns = recent[0].t_ns if recent else self._newest_ns
        before = [Message(topic, first_ns, data) for topic, kept in self._latched.items() for data in kept]
        messages = [*before, *recent]
        used = {message.topic for message in messages}
        topics = [topic for name, topic in self._topics.items() if name in used]
        return Moment(topics, self.seconds, messages)
