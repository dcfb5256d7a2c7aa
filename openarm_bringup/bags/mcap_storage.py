# SPDX-License-Identifier: Apache-2.0
"""Reads MCAP files of any writer: with or without chunks, index, summary and end.

The summary is used where it is complete. Otherwise the file is read once to find its channels and count its messages.
"""

from __future__ import annotations

import fcntl
import os
import struct
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from rosbags.rosbag2.errors import ReaderError

from openarm_bringup.bags import mcap
from openarm_bringup.bags.mcap import MAGIC, RECORD, Kind
from openarm_bringup.bags.storage import DAMAGE, Channel, Row, channel, custom_of, merged

#: Messages outside of chunks are read in parts of this size, bytes.
_PART = 2**20
_FOOTER = struct.Struct("<BQQQI")
_CHUNK_INDEX = struct.Struct("<QQQQ")
_STATISTICS = struct.Struct("<QHIIIIQQI")


class _Part(NamedTuple):
    """A chunk, or messages outside of chunks that follow each other: its stamps, and where its records are."""

    first_ns: int
    last_ns: int
    start: int
    end: int
    chunk: bool


@dataclass
class _Summary:
    """What a file repeats at its end.

    Attributes:
        start: Offset at which it starts; the end of the data.
        chunks: Chunks by their offset; each with the offset after its indexes.
        counts: Messages of each channel; empty where it does not say it.
        stamps: First and last, ns.
    """

    start: int
    chunks: dict[int, tuple[_Part, int]] = field(default_factory=dict[int, tuple[_Part, int]])
    counts: Counter[int] = field(default_factory=Counter[int])
    stamps: tuple[int, int] = (0, -1)


class McapStorage:
    """A file that is open for reading; see `Storage`.

    A file without its end is read as far as it is whole. One of chunks gets its end again, where it can be written and
    nobody else writes it.

    Args:
        path: File.

    Raises:
        ReaderError: And others of `DAMAGE`, for content that is no MCAP.
        OSError: When the file can't be read.
    """

    def __init__(self, path: Path) -> None:
        self.given_up: int | None = None
        self.custom: Mapping[str, str] = {}
        self._schemas: dict[int, tuple[str, str, bytes]] = {}
        self._channels: dict[int, tuple[int, str, str, str]] = {}
        self._file = path.open("rb")
        try:
            self._size = path.stat().st_size
            closed = mcap.is_closed(path)
            self._open(closed)
            if not closed and all(part.chunk for part in self._parts) and self._may_be_written(path):
                mcap.give_end(path, [(part.start, part.end) for part in self._parts])
        except BaseException:
            self._file.close()
            raise

    def _may_be_written(self, path: Path) -> bool:
        """Whether the file can be written, and no recorder still writes it: then it grants a lease to a reader."""
        try:
            fcntl.fcntl(self._file, fcntl.F_SETLEASE, fcntl.F_RDLCK)
            fcntl.fcntl(self._file, fcntl.F_SETLEASE, fcntl.F_UNLCK)
        except BlockingIOError:
            return False
        except OSError:  # a file system without leases
            pass
        return os.access(path, os.W_OK)

    def _open(self, closed: bool) -> None:
        summary = self._summary() if closed else _Summary(self._size)
        self._parts, end = self._walk(summary, closed)
        counts, (self.start_ns, self.end_ns) = summary.counts, summary.stamps
        chunks = sum(part.chunk for part in self._parts)
        if not counts or chunks != len(summary.chunks) or not counts.keys() <= self._channels.keys():
            counts, end = self._counted(closed, end)
            self.start_ns = min(part.first_ns for part in self._parts) if counts else 0
            self.end_ns = max((part.last_ns for part in self._parts), default=-1)
        if not closed:
            self.given_up = self._size - end
            if not counts:
                raise ReaderError("it was cut short before anything whole was written; record it again")
        self.channels = [self._described(number, counts[number]) for number in sorted(self._channels)]
        self._schemas.clear()

    def close(self) -> None:
        """Let go of the file."""
        self._file.close()

    def rows(self, channels: Collection[Channel], start_ns: int | None) -> Iterator[Row]:
        """Messages of channels in the order of their stamps, from a stamp on."""
        wanted = {one.number: one for one in channels}
        parts = [part for part in self._parts if start_ns is None or part.last_ns >= start_ns]
        yield from merged((part.first_ns, self._rows(part, wanted, start_ns)) for part in parts)

    def _rows(self, part: _Part, wanted: Mapping[int, Channel], start_ns: int | None) -> Iterator[Row]:
        found: list[Row] = []
        for kind, _, content in mcap.records(self._content(part)):
            if kind == Kind.MESSAGE:
                number, t_ns = mcap.message_head(content)
                if number in wanted and (start_ns is None or t_ns >= start_ns):
                    found.append(Row(t_ns, wanted[number], mcap.message_data(content)))
        found.sort(key=lambda row: row.t_ns)
        yield from found

    # --- what is where
    def _read(self, at: int, size: int) -> bytes:
        if at + size > self._size or size > mcap.MAX_UNPACKED + _PART:
            raise ReaderError(f"{size} bytes at {at} of {self._size} are more than a file holds")
        self._file.seek(at)
        return self._file.read(size)

    def _summary(self) -> _Summary:
        """Read channels, chunks and counts at the end of the file."""
        at = self._size - len(MAGIC) - _FOOTER.size
        if at < len(MAGIC):
            raise ReaderError("it has no footer")
        kind, length, start, _, _ = _FOOTER.unpack(self._read(at, _FOOTER.size))
        if kind != Kind.FOOTER or length != _FOOTER.size - RECORD.size or start > at:
            raise ReaderError("its footer is damaged")
        summary = _Summary(start or at)
        for kind, _, content in mcap.records(memoryview(self._read(summary.start, at - summary.start))):
            if kind in (Kind.SCHEMA, Kind.CHANNEL):
                self._learn(kind, content)
            elif kind == Kind.CHUNK_INDEX:
                first_ns, last_ns, place, size = _CHUNK_INDEX.unpack_from(content)
                (offsets,) = struct.unpack_from("<I", content, _CHUNK_INDEX.size)
                (indexes,) = struct.unpack_from("<Q", content, _CHUNK_INDEX.size + 4 + offsets)
                end = place + max(size, RECORD.size)
                summary.chunks[place] = _Part(first_ns, last_ns, place, end, True), end + indexes
            elif kind == Kind.STATISTICS:
                messages, *_, first_ns, last_ns, size = _STATISTICS.unpack_from(content)
                counts = Counter(dict(struct.iter_unpack("<HQ", content[_STATISTICS.size : _STATISTICS.size + size])))
                if messages == counts.total():
                    summary.counts = counts
                    summary.stamps = (first_ns, last_ns) if messages else summary.stamps
        return summary

    def _walk(self, summary: _Summary, closed: bool) -> tuple[list[_Part], int]:
        """Go through the records of the data section; return its parts, and where its last whole record ends."""
        parts: list[_Part] = []
        at = len(MAGIC)
        while at + RECORD.size <= summary.start:
            if at in summary.chunks:
                part, at = summary.chunks[at]
                parts.append(part)
                continue
            kind, length = RECORD.unpack(self._read(at, RECORD.size))
            start, content = at, at + RECORD.size
            if kind == Kind.DATA_END:
                break
            if kind not in mcap.DATA or content + length > summary.start:
                if closed:
                    raise ReaderError(f"its record at {at} is damaged")
                break
            at = content + length
            if kind == Kind.CHUNK:
                first_ns, last_ns = mcap.chunk_stamps(self._read(content, 16))
                parts.append(_Part(first_ns, last_ns, start, at, True))
            elif kind == Kind.MESSAGE:
                _, t_ns = mcap.message_head(self._read(content, 22))
                _put(parts, t_ns, start, at)
            elif kind in (Kind.SCHEMA, Kind.CHANNEL, Kind.METADATA):
                self._learn(kind, memoryview(self._read(content, length)))
        return parts, at

    def _counted(self, closed: bool, end: int) -> tuple[Counter[int], int]:
        """Read all parts for their channels, counts and stamps; return also where the last whole part ends.

        Parts at the end of a file that was cut may be damaged whatever their length, as after a loss of power.
        """
        counts, whole = Counter[int](), list[_Part]()
        while self._parts and not closed:
            try:
                self._count(self._parts[-1])
                break
            except DAMAGE:
                end = self._parts.pop().start
        for part in self._parts:
            found, first_ns, last_ns = self._count(part)
            counts += found
            whole.append(part._replace(first_ns=first_ns, last_ns=last_ns))
        self._parts = whole
        return counts, end

    def _count(self, part: _Part) -> tuple[Counter[int], int, int]:
        """Take the channels of a part; count the messages of each, and return also their first and last stamp."""
        counts, first_ns, last_ns = Counter[int](), 2**64, -1
        for kind, _, content in mcap.records(self._content(part)):
            if kind == Kind.MESSAGE:
                number, t_ns = mcap.message_head(content)
                counts[number] += 1
                first_ns, last_ns = min(first_ns, t_ns), max(last_ns, t_ns)
            elif kind in (Kind.SCHEMA, Kind.CHANNEL):
                self._learn(kind, content)
        return counts, first_ns, last_ns

    def _content(self, part: _Part) -> memoryview:
        """Return the records of a part, unpacked."""
        data = memoryview(self._read(part.start, part.end - part.start))
        if not part.chunk:
            return data
        kind, length = RECORD.unpack_from(data)
        if kind != Kind.CHUNK or length != len(data) - RECORD.size:
            raise ReaderError(f"expected a chunk at {part.start}, found a record of kind {kind} with {length} bytes")
        return mcap.chunk_records(data[RECORD.size :])

    # --- what it is
    def _learn(self, kind: int, content: memoryview) -> None:
        """Take a schema, a channel or metadata."""
        if kind == Kind.METADATA:
            name, at = _text(content, 0)
            if name == "rosbag2":
                self.custom = custom_of(_map(content, at).get("serialized_metadata", ""))
            return
        (number,) = struct.unpack_from("<H", content)
        if kind == Kind.SCHEMA:
            name, at = _text(content, 2)
            encoding, at = _text(content, at)
            text, _ = _bytes(content, at)
            self._schemas.setdefault(number, (name, encoding, text))
        else:
            (schema,) = struct.unpack_from("<H", content, 2)
            topic, at = _text(content, 4)
            encoding, at = _text(content, at)
            qos = _map(content, at).get("offered_qos_profiles", "")
            self._channels.setdefault(number, (schema, topic, encoding, qos))

    def _described(self, number: int, count: int) -> Channel:
        schema, topic, encoding, qos = self._channels[number]
        kind, schema_encoding, text = self._schemas.get(schema, ("", "", b""))
        return channel(number, topic, kind, count, encoding=encoding, schema=schema_encoding, text=text, qos=qos)


def _put(parts: list[_Part], t_ns: int, start: int, end: int) -> None:
    """Add a message outside of chunks: to the last part while it is small, or as a new one."""
    last = parts[-1] if parts else None
    if last is not None and not last.chunk and last.end == start and start - last.start < _PART:
        parts[-1] = _Part(min(last.first_ns, t_ns), max(last.last_ns, t_ns), last.start, end, False)
    else:
        parts.append(_Part(t_ns, t_ns, start, end, False))


def _bytes(content: memoryview, at: int) -> tuple[bytes, int]:
    (length,) = struct.unpack_from("<I", content, at)
    end = at + 4 + length
    if end > len(content):
        raise ReaderError(f"a text has {length} bytes, more than there are")
    return bytes(content[at + 4 : end]), end


def _text(content: memoryview, at: int) -> tuple[str, int]:
    data, end = _bytes(content, at)
    return data.decode(), end


def _map(content: memoryview, at: int) -> dict[str, str]:
    """Read texts by their keys."""
    (length,) = struct.unpack_from("<I", content, at)
    at, end, found = at + 4, at + 4 + length, dict[str, str]()
    while at < end:
        key, at = _text(content, at)
        found[key], at = _text(content, at)
    return found
