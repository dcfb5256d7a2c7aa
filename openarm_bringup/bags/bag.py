# SPDX-License-Identifier: Apache-2.0
"""Bags: rosbag2 folders with MCAP files are written by rosbags, those and others are read; nothing is deserialised.

Stamps of a bag are when a message was received, ns of the system clock. The text of a message definition is made from
the installed Python class, so that every installed type can be recorded, also a user's own.
"""

from __future__ import annotations

import shutil
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

from rosbags.interfaces import Connection, Qos, QosDurability, QosReliability
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from openarm_bringup.bags.definitions import changed_type, definition, event_definition, is_event, nested_types
from openarm_bringup.bags.files import ZSTD, find, open_storage
from openarm_bringup.bags.mcap import unpack
from openarm_bringup.bags.storage import DAMAGE, Channel, Storage, merged
from openarm_bringup.messages import interface
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.printable import printable

#: This much of the disk is left free, so that the bag can still be closed.
SPARE_BYTES = 200 * 2**20
#: Of zstd. Clouds come out smaller at 1 than at its default of 3, in half the time.
_LEVEL = 1
#: Errors that may come from what was left out of a bag.
_MISSING = (Code.INVALID_ARGUMENT, Code.NOTHING_DETECTED, Code.NO_TRANSFORM)
#: Topics that an error names.
_NAMED = 8
#: As the middleware writes it.
_NO_HASH = "INVALID"


def check_room(folder: Path) -> int:
    """Refuse to fill a disk to the end; return how many bytes may be written until it is checked again.

    Raises:
        OSError: When less than `SPARE_BYTES` are free.
    """
    free = shutil.disk_usage(folder).free
    if free < SPARE_BYTES:
        raise OSError(f"the disk has only {free // 2**20} MiB left")
    return SPARE_BYTES // 8


class Topic(NamedTuple):
    """A topic that is recorded, with the quality of service that its publishers offer."""

    name: str
    type: str
    qos: Qos


class Message(NamedTuple):
    """As it was received: `data` is CDR, the stamp that of the middleware, ns of the system clock."""

    topic: str
    t_ns: int
    data: bytes


@dataclass(frozen=True)
class Record:
    """A message as it is in a bag: `data` is CDR."""

    topic: str
    type: str
    t_ns: int
    data: bytes


class BagWriter:
    """Writes a bag; a context manager.

    Args:
        path: Folder of the bag, which must not exist.
        custom: Kept in the metadata: versions, graph, parameters.
        compress: Whether chunks are compressed (zstd).

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder exists or can't be made.
    """

    def __init__(self, path: Path, custom: Mapping[str, str], *, compress: bool = True) -> None:
        if path.exists():
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"{path} exists; give the bag another name, a bag is never overwritten"
            )
        self._types = get_typestore(Stores.ROS2_JAZZY)
        self._writer = Writer(path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP)
        if compress:
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._compress = compress
        for key, value in custom.items():
            self.remember(key, value)
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        try:
            self._writer.open()
        except OSError as error:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"can't make the bag {self._writer.path}: {error}") from error
        if self._compress:
            storage = self._storage()
            self._pack = partial(storage.compressor, level=_LEVEL)  # pyright: ignore[reportCallIssue]  # zstd.compress
            self.hasten(False)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: object) -> None:
        if isinstance(error, OSError):
            self._writer.abort()  # a full disk takes no index either; `open_bag` mends the file
        else:
            self._writer.close()

    def remember(self, key: str, value: str) -> None:
        """Keep something in the metadata, which are written at the end."""
        self._writer.set_custom_data(key, value)

    def add_topic(self, topic: str, kind: str, qos: Qos) -> None:
        """Say what a topic is, before its first message.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when no installed package has its type.
        """
        text, type_hash = None, None  # by the type store
        if is_event(kind):  # which knows messages only
            text, type_hash = event_definition(kind), _NO_HASH
        else:
            self._learn(kind)
        self._connections[topic] = self._writer.add_connection(
            topic, kind, typestore=self._types, msgdef=text, rihs01=type_hash, offered_qos_profiles=[qos]
        )

    def _learn(self, kind: str) -> None:
        """Register a type, such as `sensor_msgs/msg/Image`, and all that it is made of."""
        if kind not in self._types.types:
            message = interface(kind)
            for inner in nested_types(message):
                self._learn(inner)
            self._types.register(get_types_from_msg(definition(message), kind))

    def hasten(self, now: bool) -> None:
        """Leave out compression from here on, or take it up again; a file may hold chunks of both kinds."""
        if self._compress:
            storage = self._storage()
            storage.compression, storage.compressor = ("", bytes) if now else ("zstd", self._pack)

    def _storage(self) -> McapWriter:
        assert isinstance(self._writer.storage, McapWriter)  # it is open
        return self._writer.storage

    def write(self, topic: str, t_ns: int, data: bytes) -> None:
        """Append a message.

        Raises:
            OSError: When the disk is full.
        """
        self._writer.write(self._connections[topic], t_ns, data)


class Bag:
    """A bag that is open for reading; made by `open_bag`.

    Attributes:
        path: Path that was given.
        topics: Type and offered quality of service of each topic whose messages are CDR of a ROS 2 type.
        counts: Messages by topic.
        left_out: Why messages are left out, by topic: of another encoding, or of another type than most of the topic.
        custom: Custom data that was kept with it.
        start_ns: Stamp of the first message.
        duration_s: Time from the first message to the last.
        mended: Bytes of an unfinished file that were given up; None for a bag that was closed in order.
    """

    def __init__(self, path: Path, files: Sequence[Storage], custom: Mapping[str, str]) -> None:
        self.path = path
        self._files = files
        self.custom = custom
        lost = [file.given_up for file in files if file.given_up is not None]
        self.mended = sum(lost) if lost else None
        by_topic: defaultdict[str, list[Channel]] = defaultdict(list[Channel])
        for channel in (channel for file in files for channel in file.channels):
            by_topic[channel.topic].append(channel)
        self._channels: dict[str, list[Channel]] = {}
        self.left_out: dict[str, str] = {}
        self._why_not: dict[str, str] = {}
        for topic, channels in by_topic.items():
            counts = Counter[str]()
            for channel in channels:
                counts[channel.encoding or channel.type] += channel.count
            ours = {channel.type for channel in channels if not channel.encoding}
            if kind := max(ours, key=lambda one: (counts[one], one), default=""):
                self._channels[topic] = [c for c in channels if not c.encoding and c.type == kind]
            others = [f"{n} message{'s' * (n != 1)} of {what}" for what, n in counts.items() if what != kind]
            if others:
                self.left_out[topic] = ", ".join(others)
        self.topics = {topic: (some[0].type, _strongest(some)) for topic, some in self._channels.items()}
        self.counts = {topic: sum(channel.count for channel in some) for topic, some in self._channels.items()}
        with_messages = [file for file in files if file.end_ns >= file.start_ns]
        self.start_ns = min((file.start_ns for file in with_messages), default=0)
        self.duration_s = (max((file.end_ns for file in with_messages), default=0) - self.start_ns) * 1e-9

    def why_not(self, topic: str) -> str:
        """Return why the messages of a topic are not of the installed type of that name; empty when they are.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when no installed package has the type.
        """
        if topic not in self._why_not:
            self._why_not[topic] = self._changed(topic)
        return self._why_not[topic]

    def _changed(self, topic: str) -> str:
        kind, _ = self.topics[topic]
        if not hasattr(interface(kind), "get_fields_and_field_types"):
            return f"{topic} was recorded as {kind}, which is no message"
        for recorded in dict.fromkeys(channel.definition for channel in self._channels[topic]):
            if changed := changed_type(recorded, kind):
                return f"{topic} was recorded with other fields of {changed} than the installed ones"
        return ""

    def records(self, topics: Sequence[str] | None = None, start_s: float = 0.0) -> Iterator[Record]:
        """Messages in the order in which they were received.

        Args:
            topics: Only these; None takes all.
            start_s: Only from this long after the first on.
        """
        chosen = {id(c) for t, some in self._channels.items() if topics is None or t in topics for c in some}
        start_ns = self.start_ns + round(start_s * 1e9) if start_s else None
        sources = [
            (file.start_ns, file.rows(wanted, start_ns))
            for file in self._files
            if (wanted := [channel for channel in file.channels if id(channel) in chosen])
        ]
        try:
            for t_ns, channel, data in merged(sources):
                content = unpack(data) if data.startswith(ZSTD) else data
                yield Record(channel.topic, channel.type, t_ns, content)
        except (*DAMAGE, OSError) as error:
            raise damaged(self.path, error) from error


def _strongest(channels: Sequence[Channel]) -> Qos | None:
    """Return a quality of service that serves every subscriber which one of several publishers served."""
    offered = [channel.qos for channel in channels if channel.qos is not None]
    if not offered:
        return None
    latched = [qos for qos in offered if qos.durability == QosDurability.TRANSIENT_LOCAL]
    reliable = any(qos.reliability != QosReliability.BEST_EFFORT for qos in offered)
    best = max(latched or offered, key=lambda qos: qos.depth)
    return best._replace(reliability=QosReliability.RELIABLE) if reliable else best


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a rosbag2 folder, or a file of MCAP or of SQLite (.db3), for reading.

    A recording that was cut short (SIGKILL, full disk) lacks its end: everything whole in it is kept. Topics that are
    no messages of ROS 2 are left out; an error that may come from this names them.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is missing, empty, truncated beyond use, or something else.
    """
    with ExitStack() as stack:
        try:
            source = find(path, stack)
            files = [stack.enter_context(closing(open_storage(file))) for file in source.files]
            custom = source.custom or next((file.custom for file in files if file.custom), {})
            bag = Bag(path, files, custom)
        except (*DAMAGE, OSError) as error:
            raise damaged(path, error) from error
        if bag.left_out and not bag.topics:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"{path} has no messages of ROS 2: {listed(bag.left_out)}; expected CDR of types in ros2msg or ros2idl,"
                " as `ros2 bag record` and `openarm record` write: record or convert these topics as ROS 2 messages",
            )
        try:
            yield bag
        except OpenArmError as error:
            if not bag.left_out or error.code not in _MISSING:
                raise
            raise OpenArmError(error.code, f"{error.message}; left out of {path}: {listed(bag.left_out)}") from error


def listed(reasons: Mapping[str, str]) -> str:
    """Return topics with what is said of each, in one line; of many, the first."""
    parts = [f"{printable(topic, longest=100)}: {printable(why, longest=200)}" for topic, why in reasons.items()]
    more = f" and {len(parts) - _NAMED} more" if len(parts) > _NAMED else ""
    return "; ".join(parts[:_NAMED]) + more


def damaged(path: Path, error: Exception) -> OpenArmError:
    """Return the error of a bag whose content is not what its format says, in one sentence."""
    text = f"{path} can't be read as a bag: {type(error).__name__}: {said(error)}"
    # errors of ours say more; SQLite's way is in them
    way = (
        "" if ";" in text else "; copy it again, or save what is whole of an .mcap by `mcap recover FILE -o SAVED.mcap`"
    )
    return OpenArmError(Code.INVALID_ARGUMENT, text + way)
