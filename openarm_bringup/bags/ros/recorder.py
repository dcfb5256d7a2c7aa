# SPDX-License-Identifier: Apache-2.0
"""Records topics of a running graph into a bag, as raw CDR.

Messages are taken in one thread and written in another, with a bounded queue between them. What does not fit is
counted as lost, and so is what never arrived, by the sequence numbers of the publishers.
"""

from __future__ import annotations

import os
import queue
import threading
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from openarm_bringup.bags.bag import BagWriter, Message, Topic, check_room
from openarm_bringup.bags.ros.listener import Listener
from openarm_bringup.supervision.discovery import PROFILE
from openarm_bringup.supervision.environment import profiled
from openarm_bringup.supervision.shm import without_reader
from openarm_common.errors import OpenArmError
from openarm_common.ports import held
from openarm_common.resources import config_dir
from openarm_common.ros.client import ContextNode

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


class Recorder(ContextNode):
    """Records until `stop`; a context manager.

    Args:
        domain: ROS_DOMAIN_ID of the graph.
        path: Folder of the bag.
        patterns: Regular expressions; a topic whose whole name matches one is recorded, also when it comes later.
        custom: Kept in the metadata.
        image_rate: Largest rate of each image stream, Hz of their stamps; 0 keeps all.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pattern that is none or a folder that exists.
    """

    def __init__(
        self, domain: int, path: Path, patterns: tuple[str, ...], custom: Mapping[str, str], image_rate: float = 0.0
    ) -> None:
        profile = os.environ.get(PROFILE) or config_dir() / "fastdds_recorder.xml"  # a user's own comes first
        # What a publisher has opened in place of a process that was killed holds 512 messages, whoever reads it next.
        with profiled(Path(profile)), held(without_reader(domain)):
            super().__init__("openarm_recorder", domain=domain)
        # Only the writing thread touches the bag: topics reach it through the queue as messages do.
        self._queue: queue.SimpleQueue[Topic | Message | None] = queue.SimpleQueue()
        self._bytes_in = self._bytes_out = 0  # each counted by one thread
        try:
            self._listener = Listener(self._node, patterns, self._put, image_rate=image_rate)
            self._bag = BagWriter(path, custom)
        except OpenArmError:
            super().close()
            raise
        self.recorded = Recorded(lost=self._listener.lost)
        self._path = path
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
        return sorted(self._listener.topics)

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
        self._listener.discover()
        self._began.set()
        found_at = time.monotonic()
        while not self._end.wait(_LOOK_S):
            if time.monotonic() - found_at > _DISCOVERY_S:
                self._listener.discover()
                found_at = time.monotonic()
            self._listener.drain()
        self._listener.drain()  # what has come until the end

    def _put(self, item: Topic | Message) -> None:
        if isinstance(item, Message):
            # Where the disk can't keep up, large messages are dropped first.
            limit = _QUEUE_BYTES if len(item.data) > _LARGE else 2 * _QUEUE_BYTES
            if self._bytes_in - self._bytes_out > limit or self.recorded.ended:
                self.recorded.lost[item.topic] += 1
                return
            self._bytes_in += len(item.data)
        self._queue.put(item)

    def _write(self) -> None:
        checked = 0
        while (item := self._queue.get()) is not None:
            if isinstance(item, Topic):
                self._bag.add_topic(*item)
                continue
            topic, t_ns, data = item
            self._bytes_out += len(data)
            if self.recorded.ended:
                self.recorded.lost[topic] += 1
                continue
            try:
                if self.recorded.bytes >= checked:
                    checked = self.recorded.bytes + check_room(self._path)
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
