# SPDX-License-Identifier: Apache-2.0
"""What the files of a recording have in common, however they are stored: channels, and messages by their stamps."""

from __future__ import annotations

import heapq
import sqlite3
import struct
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat, Qos
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.metadata import parse_qos
from rosbags.rosbag2.storage_mcap import zstd

from openarm_common.config import parse_yaml
from openarm_common.errors import OpenArmError

#: What is raised where the content of a file is not what its format says.
DAMAGE = (
    ReaderError, zstd.ZstdError, sqlite3.Error, struct.error, ArithmeticError, AssertionError, AttributeError, EOFError,
    LookupError, MemoryError, RuntimeError, TypeError, ValueError,
)  # fmt: skip
#: Largest chunk or message, unpacked, bytes.
MAX_UNPACKED = 256 * 2**20
_FORMATS = {
    "ros2msg": MessageDefinitionFormat.MSG,
    "ros2idl": MessageDefinitionFormat.IDL,
    "omgidl": MessageDefinitionFormat.IDL,
}
#: Of a definition that rosbag2 did not find when it recorded.
_UNDEFINED = ("", "unknown")


@dataclass(frozen=True)
class Channel:
    """Messages of one publisher, or of several with one quality of service.

    Attributes:
        number: Within its file.
        topic: Name.
        type: Such as `sensor_msgs/msg/Image`.
        definition: Text that the recording has of the type.
        qos: Offered quality of service; None where the recording does not say it.
        count: Number of messages.
        encoding: Encoding of messages that nothing here can read: no CDR of a ROS 2 type; empty for the others.
    """

    number: int
    topic: str
    type: str
    definition: MessageDefinition
    qos: Qos | None
    count: int
    encoding: str


class Row(NamedTuple):
    """A message in a file: received at `t_ns` of the system clock; `data` may be compressed."""

    t_ns: int
    channel: Channel
    data: bytes


class Storage(Protocol):
    """A file of a recording, open for reading.

    Attributes:
        channels: Channels in the order of their numbers.
        start_ns: Stamp of the first message.
        end_ns: Stamp of the last message; before `start_ns` where there is none.
        custom: Custom data of the recording, where the file has it.
        given_up: Bytes after the last whole record; None for a file that was closed in order.
    """

    channels: list[Channel]
    given_up: int | None
    start_ns: int
    end_ns: int
    custom: Mapping[str, str]

    def rows(self, channels: Collection[Channel], start_ns: int | None) -> Iterator[Row]:
        """Messages of channels in the order of their stamps, from a stamp on."""
        ...

    def close(self) -> None:
        """Let go of the file."""
        ...


def channel(
    number: int, topic: str, kind: str, count: int, *, encoding: str, schema: str, text: bytes, qos: str
) -> Channel:
    """Return a channel as a file describes it.

    Args:
        number: Within the file.
        topic: Name.
        kind: Name of the type: `package/msg/Name`, `package/Name` or `package::msg::Name`.
        count: Number of messages.
        encoding: Encoding of the messages; `cdr` is ROS 2's.
        schema: Encoding of the type's definition, such as `ros2msg`.
        text: Definition of the type.
        qos: Offered qualities of service, YAML.
    """
    ours = encoding == "cdr" and bool(kind) and (schema in _FORMATS or schema in _UNDEFINED)
    parts = kind.replace("::", "/").split("/")
    name = "/".join((parts[0], "msg", parts[1]) if len(parts) == 2 else parts)
    known = ours and schema in _FORMATS
    definition = MessageDefinition(
        _FORMATS[schema] if known else MessageDefinitionFormat.NONE, text.decode() if known else ""
    )
    foreign = "" if ours else f"{encoding or 'no encoding'} ({schema or 'no schema'})"
    return Channel(number, topic, name, definition, _qos(qos), count, foreign)


def _qos(text: str) -> Qos | None:
    """Return the first quality of service of a text; None where it has none that can be read."""
    try:
        return next(iter(parse_qos(text)), None)
    except DAMAGE:
        return None


def custom_of(metadata: str) -> Mapping[str, str]:
    """Return what was kept with a recording, from the copy of its metadata in the file; empty where it says nothing."""
    try:
        document: Any = parse_yaml(metadata, "metadata")
        return custom_in(document.get("rosbag2_bagfile_information", document))
    except (OpenArmError, AttributeError):
        return {}


def custom_in(about: Mapping[str, Any]) -> Mapping[str, str]:
    """Return what was kept with a recording, from its metadata."""
    custom = about.get("custom_data")
    return {str(key): str(value) for key, value in custom.items()} if isinstance(custom, dict) else {}


def merged(sources: Iterable[tuple[int, Iterable[Row]]]) -> Iterator[Row]:
    """Merge sources by their stamps; each is begun when its first stamp is due.

    Args:
        sources: First stamp, ns, and messages in the order of their stamps.
    """
    waiting = [(start_ns, k, None, iter(rows)) for k, (start_ns, rows) in enumerate(sources)]
    heap: list[tuple[int, int, Row | None, Iterator[Row]]] = [*waiting]
    heapq.heapify(heap)
    while heap:
        _, k, row, rest = heap[0]
        if row is not None:
            yield row
        following = next(rest, None)
        if following is None:
            heapq.heappop(heap)
        else:
            heapq.heapreplace(heap, (following.t_ns, k, following, rest))
