# SPDX-License-Identifier: Apache-2.0
"""The end of an MCAP file that was cut short is written anew (https://mcap.dev/spec).

A file is a magic, records (one byte of kind, eight of length, content), a footer record and the magic again. Without
the end no reader opens it, though all records before the cut are whole.
"""

from __future__ import annotations

import os
import struct
from pathlib import Path

from openarm_common.errors import Code, OpenArmError

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _CHUNK, _DATA_END = 0x01, 0x02, 0x06, 0x0F
#: Records of the data section; what follows them is a summary, which would be incomplete.
_DATA = (_HEADER, 0x03, 0x04, 0x05, _CHUNK, 0x07, 0x09, 0x0C)
_HEAD = struct.Struct("<BQ")


def mend(path: Path) -> int | None:
    """Give a file that was cut short its end; a file that has one is left as it is.

    Returns:
        Bytes after the last whole record, which were given up; None when there was nothing to mend.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is no MCAP file, or nothing in it is whole.
    """
    size = path.stat().st_size
    with path.open("r+b") as file:
        if file.read(len(MAGIC)) != MAGIC:
            what = "is empty" if size == 0 else "is not an MCAP file (wrong magic at its start)"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} {what}")
        file.seek(-len(MAGIC), os.SEEK_END)
        if size >= 2 * len(MAGIC) and file.read() == MAGIC:
            return None
        end, chunks = _whole(file, size)
        if chunks == 0:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{path} was cut short before anything whole was written")
        file.truncate(end)
        file.seek(end)
        file.write(_HEAD.pack(_DATA_END, 4) + bytes(4))
        file.write(_HEAD.pack(_FOOTER, 20) + bytes(20) + MAGIC)  # no summary: readers scan the data
    return size - end


def _whole(file: object, size: int) -> tuple[int, int]:
    """Where the last whole record of the data ends, and how many chunks there are before it."""
    read, seek = file.read, file.seek  # type: ignore[attr-defined]
    at, chunks = len(MAGIC), 0
    while at + _HEAD.size <= size:
        seek(at)
        kind, length = _HEAD.unpack(read(_HEAD.size))
        if kind not in _DATA or at + _HEAD.size + length > size:
            break
        chunks += kind == _CHUNK
        at += _HEAD.size + length
    return at, chunks
