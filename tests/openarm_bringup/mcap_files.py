# SPDX-License-Identifier: Apache-2.0
"""MCAP files made record by record (https://mcap.dev/spec), and where the chunks of a file are."""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"


class Topic(NamedTuple):
    """A channel with its schema, and its messages: stamp and content."""

    name: str
    type: str
    messages: Sequence[tuple[int, bytes]]
    encoding: str = "cdr"
    schema: str = "ros2msg"
    text: bytes = b""


def record(kind: int, content: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(content)) + content


def text(value: str | bytes) -> bytes:
    data = value.encode() if isinstance(value, str) else value
    return struct.pack("<I", len(data)) + data


def head(profile: str = "ros2") -> bytes:
    return MAGIC + record(0x01, text(profile) + text("test"))


def end() -> bytes:
    """An end without a summary."""
    return record(0x0F, bytes(4)) + record(0x02, bytes(20)) + MAGIC


def channels(topics: Sequence[Topic]) -> bytes:
    parts: list[bytes] = []
    for k, topic in enumerate(topics, 1):
        if topic.schema:
            schema = struct.pack("<H", k) + text(topic.type) + text(topic.schema) + text(topic.text)
            parts.append(record(0x03, schema))
        number = struct.pack("<HH", k, k if topic.schema else 0)
        parts.append(record(0x04, number + text(topic.name) + text(topic.encoding) + text(b"")))
    return b"".join(parts)


def messages(topics: Sequence[Topic]) -> list[bytes]:
    """The records of all messages, one topic after the other."""
    return [
        record(0x05, struct.pack("<HIQQ", k, i, t_ns, t_ns) + data)
        for k, topic in enumerate(topics, 1)
        for i, (t_ns, data) in enumerate(topic.messages)
    ]


def chunk(records: Iterable[bytes], stamps: tuple[int, int]) -> bytes:
    data = b"".join(records)
    return record(0x06, struct.pack("<QQQI", *stamps, len(data), 0) + text("") + struct.pack("<Q", len(data)) + data)


def unchunked(path: Path, topics: Sequence[Topic], *, profile: str = "ros2", closed: bool = True) -> Path:
    """Write a file without chunks, index and summary."""
    body = channels(topics) + b"".join(messages(topics))
    path.write_bytes(head(profile) + body + (end() if closed else b""))
    return path


def chunks_of(path: Path) -> list[tuple[int, int]]:
    """Start and end of each chunk."""
    data, at, found = path.read_bytes(), len(MAGIC), list[tuple[int, int]]()
    while at + 9 <= len(data):
        kind, length = struct.unpack_from("<BQ", data, at)
        if kind == 0x06 and at + 9 + length <= len(data):
            found.append((at, at + 9 + length))
        at += 9 + length
    return found
