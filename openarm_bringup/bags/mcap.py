# SPDX-License-Identifier: Apache-2.0
"""Records of MCAP files (https://mcap.dev/spec), unpacked within bounds, and the end of a file that was cut short.

A file is a magic, records (one byte of kind, eight of length, content), a summary, a footer record and the magic again.
Without the end few readers open it, and without the summary's index of chunks few give the messages of several topics
in the order of their stamps, though all records before the cut are whole.
"""

from __future__ import annotations

import os
import struct
from collections import defaultdict
from collections.abc import Iterator, Sequence
from enum import IntEnum
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, decompress, zstd

MAGIC = b"\x89MCAP0\r\n"
RECORD = struct.Struct("<BQ")
#: Of a chunk: first and last stamp, size unpacked, its CRC, length of the compression's name.
_OF_CHUNK = struct.Struct("<QQQII")
#: Of a message: channel, number, stamp, stamp of its publisher.
_OF_MESSAGE = struct.Struct("<HIQQ")


class Kind(IntEnum):
    """Records; those from 0x80 on are of whoever wrote the file."""

    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    STATISTICS = 0x0B
    METADATA = 0x0C
    DATA_END = 0x0F


#: Records of the data section; what follows them is a summary, which would be incomplete.
DATA = (
    Kind.HEADER, Kind.SCHEMA, Kind.CHANNEL, Kind.MESSAGE, Kind.CHUNK, Kind.INDEX, Kind.ATTACHMENT, Kind.METADATA,
    *range(0x80, 0x100),
)  # fmt: skip
#: Largest chunk or message, unpacked, bytes.
MAX_UNPACKED = 256 * 2**20


def unpack(data: bytes, size: int = MAX_UNPACKED, *, kind: str = "zstd") -> bytes:
    """Decompress a chunk or a message, and never more than it may hold.

    Args:
        data: Compressed.
        size: Largest size, bytes.
        kind: `zstd` or `lz4`.

    Raises:
        ReaderError: When it is larger than `size` or `MAX_UNPACKED`, or truncated.
    """
    most = min(size, MAX_UNPACKED)
    unpacker: Any = zstd.ZstdDecompressor() if kind == "zstd" else LZ4FrameDecompressor()
    content: bytes = unpacker.decompress(data, max_length=most + 1)
    if len(content) > most or not unpacker.eof:
        raise ReaderError(f"{len(data)} bytes of {kind} are truncated, or unpack to more than {most} bytes")
    return content


# The reader's own unpack whatever the data says, before they compare its size.
DECOMPRESSORS["zstd"] = unpack
DECOMPRESSORS["lz4"] = partial(unpack, kind="lz4")


class MessageHead(NamedTuple):
    """Channel and stamp, ns, of a message."""

    channel: int
    t_ns: int


def message_head(content: bytes | memoryview) -> MessageHead:
    """Return the head of the content of a message's record."""
    channel, _, t_ns, _ = _OF_MESSAGE.unpack_from(content)
    return MessageHead(channel, t_ns)


def message_data(content: memoryview) -> bytes:
    """Return what follows the head."""
    return bytes(content[_OF_MESSAGE.size :])


def records(content: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """Yield kind, place and content of each record.

    Raises:
        ReaderError: When a record is longer than what there is.
    """
    at = 0
    while at < len(content):
        kind, length = RECORD.unpack_from(content, at)
        start = at + RECORD.size
        if start + length > len(content):
            raise ReaderError(f"a record has {length} bytes, more than there are")
        yield kind, at, content[start : start + length]
        at = start + length


def chunk_stamps(content: bytes | memoryview) -> tuple[int, int]:
    """Return the first and the last stamp of a chunk, ns, from the first bytes of its content."""
    return struct.unpack_from("<QQ", content)


def chunk_records(content: memoryview) -> memoryview:
    """Return the records of a chunk, unpacked.

    Raises:
        ReaderError: When it is damaged, or larger than `MAX_UNPACKED`.
    """
    _, _, unpacked, crc, name = _OF_CHUNK.unpack_from(content)
    at = _OF_CHUNK.size + name
    compression = bytes(content[_OF_CHUNK.size : at]).decode()
    (packed,) = struct.unpack_from("<Q", content, at)
    return memoryview(decompress(bytes(content[at + 8 : at + 8 + packed]), compression, unpacked, crc))


def is_closed(path: Path) -> bool:
    """Whether a file has its end."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        if file.tell() < 2 * len(MAGIC):
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        return file.read() == MAGIC


def give_end(path: Path, chunks: Sequence[tuple[int, int]]) -> None:
    """Give a file that was cut short its end, for other tools; what follows its last whole chunk is removed.

    Args:
        path: File that can be written.
        chunks: Start and end of each chunk, all whole.
    """
    with path.open("r+b") as file:
        # Whether all indexes of the last chunk were written only its content shows: they are made again.
        file.seek(chunks[-1][1])
        file.write(b"".join(_record(Kind.INDEX, index) for index in _indexes(file, *chunks[-1])))
        file.truncate()
        starts = [*(start for start, _ in chunks[1:]), file.tell()]
        indexed = [_chunk_index(file, *chunk, until) for chunk, until in zip(chunks, starts, strict=True)]
        file.seek(0, os.SEEK_END)
        file.write(_record(Kind.DATA_END, bytes(4)))
        summary = file.tell()
        # Counts of nothing: readers that find no schema here count for themselves while they search for them.
        file.write(b"".join(_record(Kind.CHUNK_INDEX, index) for index in indexed))
        file.write(_record(Kind.STATISTICS, bytes(46)))
        file.write(_record(Kind.FOOTER, struct.pack("<QQI", summary, 0, 0)) + MAGIC)


def _record(kind: int, content: bytes) -> bytes:
    return RECORD.pack(kind, len(content)) + content


def _indexes(file: BinaryIO, start: int, end: int) -> list[bytes]:
    """Contents of the index records of a chunk: of each channel, stamp and place of its messages."""
    found: dict[int, bytearray] = defaultdict(bytearray)
    file.seek(start + RECORD.size)
    for kind, place, content in records(chunk_records(memoryview(file.read(end - start - RECORD.size)))):
        if kind == Kind.MESSAGE:
            channel, t_ns = message_head(content)
            found[channel] += struct.pack("<QQ", t_ns, place)
    file.seek(end)
    return [struct.pack("<HI", channel, len(entries)) + entries for channel, entries in found.items()]


def _chunk_index(file: BinaryIO, start: int, end: int, until: int) -> bytes:
    """Content of the summary's record of a chunk, whose own indexes lie between it and `until`."""
    file.seek(start + RECORD.size)
    first, last, unpacked, _, name = _OF_CHUNK.unpack(file.read(_OF_CHUNK.size))
    compression = file.read(name)
    packed = file.read(8)
    offsets, at = b"", end
    while at < until:
        file.seek(at)
        kind, size = RECORD.unpack(file.read(RECORD.size))
        if kind != Kind.INDEX:
            break
        offsets += file.read(2) + struct.pack("<Q", at)
        at += RECORD.size + size
    return (
        struct.pack("<QQQQI", first, last, start, end - start, len(offsets))
        + offsets
        + struct.pack("<QI", at - end, name)
        + compression
        + packed
        + struct.pack("<Q", unpacked)
    )
