# SPDX-License-Identifier: Apache-2.0
"""The end of an MCAP file that was cut short is restored (https://mcap.dev/spec), and no file fills the memory.

A file is a magic, records (one byte of kind, eight of length, content), a summary, a footer record and the magic again.
Without the end no reader opens it, and without the summary's index of chunks none gives the messages of several topics
in the order of their stamps, though all records before the cut are whole.
"""

from __future__ import annotations

import os
import struct
from collections import defaultdict
from functools import partial
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO

from lz4.frame import LZ4FrameDecompressor
from rosbags.rosbag2.errors import ReaderError
from rosbags.rosbag2.storage_mcap import DECOMPRESSORS, decompress, zstd

from openarm_common.errors import Code, OpenArmError, said

#: What is raised where the content of a file is not what its format says.
DAMAGE = (
    ReaderError, zstd.ZstdError, struct.error, ArithmeticError, AssertionError, AttributeError, EOFError, LookupError,
    MemoryError, RuntimeError, TypeError, ValueError,
)  # fmt: skip
MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX = range(1, 8)
_CHUNK_INDEX, _STATISTICS, _DATA_END = 0x08, 0x0B, 0x0F
#: Records of the data section; what follows them is a summary, which would be incomplete.
_DATA = (_HEADER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, 0x09, 0x0C)
_HEAD = struct.Struct("<BQ")
#: Of a chunk: first and last stamp, size unpacked, its CRC, length of the compression's name.
_OF_CHUNK = struct.Struct("<QQQII")
#: Of a message: channel, number, stamp.
_OF_MESSAGE = struct.Struct("<HIQ")


#: Largest chunk or message, unpacked, bytes.
MAX_UNPACKED = 256 * 2**20


def unpack(data: bytes, size: int = MAX_UNPACKED, *, kind: str = "zstd") -> bytes:
    """Decompress a chunk or a message, and never more than it may hold.

    Args:
        data: Compressed.
        size: That it may have, bytes.
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


def is_closed(path: Path) -> bool:
    """Whether a file has its end."""
    with path.open("rb") as file:
        file.seek(0, os.SEEK_END)
        if file.tell() < 2 * len(MAGIC):
            return False
        file.seek(-len(MAGIC), os.SEEK_END)
        return file.read() == MAGIC


def mend(path: Path) -> int | None:
    """Give a file that was cut short its end; a file that has one is left as it is.

    Returns:
        Bytes after the last whole record, which were given up; None when there was nothing to mend.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is no MCAP file, or nothing in it is whole, or it can't be written.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        if file.read(len(MAGIC)) != MAGIC:
            what = "is empty" if size == 0 else "is not an MCAP file (wrong magic at its start)"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} {what}")
    if is_closed(path):
        return None
    if not os.access(path, os.W_OK):
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"{path} was cut short, and can't be written to give it an end; copy it first"
        )
    try:
        return _give_end(path, size)
    except DAMAGE as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} was cut short and is damaged: {said(error)}") from error


def _give_end(path: Path, size: int) -> int:
    with path.open("r+b") as file:
        chunks, end = whole_chunks(file, size)
        # Whether all indexes of the last chunk were written only its content shows: they are made again.
        # After a loss of power its content may be missing, whatever its length: then it is given up.
        indexes: list[bytes] | None = None
        while chunks and (indexes := _indexes(file, chunks[-1][0])) is None:
            end, _ = chunks.pop()
        if not indexes:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} was cut short before anything whole was written")
        file.seek(sum(chunks[-1]))
        file.write(b"".join(_record(_INDEX, index) for index in indexes))
        file.truncate()
        indexed = [_chunk_index(file, *chunk, until) for chunk, until in _until(chunks, file.tell())]
        file.seek(0, os.SEEK_END)
        file.write(_record(_DATA_END, bytes(4)))
        summary = file.tell()
        # Counts of nothing: readers that find no schema here count for themselves while they search for them.
        file.write(b"".join(_record(_CHUNK_INDEX, index) for index in indexed))
        file.write(_record(_STATISTICS, bytes(46)))
        file.write(_record(_FOOTER, struct.pack("<QQI", summary, 0, 0)) + MAGIC)
    return size - end


def _record(kind: int, content: bytes) -> bytes:
    return _HEAD.pack(kind, len(content)) + content


def whole_chunks(file: BinaryIO, size: int) -> tuple[list[tuple[int, int]], int]:
    """Start and length of each whole chunk, and where the last whole record of the data ends."""
    at, chunks = len(MAGIC), list[tuple[int, int]]()
    while at + _HEAD.size <= size:
        file.seek(at)
        kind, length = _HEAD.unpack(file.read(_HEAD.size))
        if kind not in _DATA or at + _HEAD.size + length > size:
            break
        if kind == _CHUNK:
            chunks.append((at, _HEAD.size + length))
        at += _HEAD.size + length
    return chunks, at


def _until(chunks: list[tuple[int, int]], end: int) -> list[tuple[tuple[int, int], int]]:
    """Each chunk, and where the next one begins."""
    return list(zip(chunks, [*(start for start, _ in chunks[1:]), end], strict=True))


def _indexes(file: BinaryIO, start: int) -> list[bytes] | None:
    """Contents of the index records of a chunk: of each channel, stamp and place of its messages; None if damaged."""
    found: dict[int, bytearray] = defaultdict(bytearray)
    try:
        file.seek(start + _HEAD.size)
        _, _, unpacked, crc, name = _OF_CHUNK.unpack(file.read(_OF_CHUNK.size))
        compression = file.read(name).decode()
        (packed,) = struct.unpack("<Q", file.read(8))
        content = BytesIO(decompress(file.read(packed), compression, unpacked, crc))
        while len(head := content.read(_HEAD.size)) == _HEAD.size:
            place = content.tell() - _HEAD.size
            kind, length = _HEAD.unpack(head)
            if kind not in (_SCHEMA, _CHANNEL, _MESSAGE):
                return None
            if kind == _MESSAGE:
                channel, _, stamp = _OF_MESSAGE.unpack(content.read(_OF_MESSAGE.size))
                found[channel] += struct.pack("<QQ", stamp, place)
            content.seek(place + _HEAD.size + length)
    except DAMAGE:
        return None
    return [struct.pack("<HI", channel, len(entries)) + entries for channel, entries in found.items()]


def _chunk_index(file: BinaryIO, start: int, length: int, until: int) -> bytes:
    """Content of the summary's record of a chunk, whose own indexes lie between it and `until`."""
    file.seek(start + _HEAD.size)
    first, last, unpacked, _, name = _OF_CHUNK.unpack(file.read(_OF_CHUNK.size))
    compression = file.read(name)
    packed = file.read(8)
    offsets, at = b"", start + length
    while at < until:
        file.seek(at)
        kind, size = _HEAD.unpack(file.read(_HEAD.size))
        if kind != _INDEX:
            break
        offsets += file.read(2) + struct.pack("<Q", at)
        at += _HEAD.size + size
    return (
        struct.pack("<QQQQI", first, last, start, length, len(offsets))
        + offsets
        + struct.pack("<QI", at - start - length, name)
        + compression
        + packed
        + struct.pack("<Q", unpacked)
    )
