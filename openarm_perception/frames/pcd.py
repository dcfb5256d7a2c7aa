# SPDX-License-Identifier: Apache-2.0
"""Clouds in PCD files: ascii, binary, binary_compressed, as PCL writes them.

Format: https://pointclouds.org/documentation/tutorials/pcd_file_format.html. The compressed form is LZF, with the
values of one field after those of the other.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.kernels import kernel
from openarm_common.types import Bytes
from openarm_perception.frames.cloud_fields import MOST_POINTS, Cloud, cloud_of, refused

#: Most bytes of a header.
_MOST_HEADER = 8192
_MOST_FIELDS, _MOST_COUNT = 64, 1024
_TYPES = {
    ("F", 4): "<f4", ("F", 8): "<f8", ("U", 1): "<u1", ("U", 2): "<u2", ("U", 4): "<u4", ("U", 8): "<u8",
    ("I", 1): "<i1", ("I", 2): "<i2", ("I", 4): "<i4", ("I", 8): "<i8",
}  # fmt: skip
_FORMS = ("ascii", "binary", "binary_compressed")


@dataclass(frozen=True)
class _Header:
    """What a header says: names and types of the fields, size of the image, form of the data, where that begins."""

    names: tuple[str, ...]
    types: tuple[str, ...]
    counts: tuple[int, ...]
    width: int
    height: int
    form: str
    begin: int

    @property
    def record(self) -> np.dtype[np.void]:
        """One point."""
        # names may be repeated in a file ("_" is padding)
        return np.dtype([(f"f{i}", t, (c,)) for i, (t, c) in enumerate(zip(self.types, self.counts, strict=True))])


def read_pcd(path: Path) -> Cloud:
    """Read a cloud.

    Raises:
        OpenArmError: BAD_IMAGE, for what is no PCD file, is cut short, has no x, y, z, or has more than MOST_POINTS
            points.
    """
    try:
        with path.open("rb") as file:
            head = _header(file.read(_MOST_HEADER), path)
            file.seek(head.begin)
            data = file.read(head.width * head.height * _most_bytes(head))
    except OSError as error:
        raise OpenArmError(Code.BAD_IMAGE, f"can't read {path}: {error.strerror}") from error
    return cloud_of(_fields(data, head, path), (head.height, head.width))


def write_pcd(path: Path, cloud: Cloud) -> None:
    """Write a cloud as binary PCD, with fields x y z, and rgb and label where it has them."""
    height, width = cloud.points.shape[:2]
    columns: list[tuple[str, str, NDArray[np.uint32] | NDArray[np.float32]]] = [
        (axis, "F", cloud.points[..., i].astype("<f4")) for i, axis in enumerate("xyz")
    ]
    if cloud.rgb is not None:
        packed = np.zeros((height, width, 4), np.uint8)
        packed[..., :3] = cloud.rgb[..., ::-1]
        columns.append(("rgb", "U", packed.view("<u4")[..., 0]))
    if cloud.label is not None:
        columns.append(("label", "U", cloud.label.astype("<u4")))
    table = np.empty((height, width), np.dtype([(name, array.dtype) for name, _, array in columns]))
    for name, _, array in columns:
        table[name] = array
    count = len(columns)
    header = [
        "VERSION 0.7", f"FIELDS {' '.join(name for name, _, _ in columns)}", f"SIZE{' 4' * count}",
        f"TYPE {' '.join(kind for _, kind, _ in columns)}", f"COUNT{' 1' * count}", f"WIDTH {width}",
        f"HEIGHT {height}", "VIEWPOINT 0 0 0 1 0 0 0", f"POINTS {width * height}", "DATA binary", "",
    ]  # fmt: skip
    path.write_bytes("\n".join(header).encode() + table.tobytes())


def _header(data: bytes, path: Path) -> _Header:
    lines: dict[str, list[str]] = {}
    begin = 0
    while "DATA" not in lines:
        end = data.find(b"\n", begin)
        if end < 0:
            raise refused(path, f"has no line DATA within {_MOST_HEADER} bytes", "a PCD file")
        words = data[begin:end].decode("ascii", errors="replace").split()
        begin = end + 1
        if words and not words[0].startswith("#"):
            lines[words[0]] = words[1:]
    names = tuple(lines.get("FIELDS", ()))
    if not 3 <= len(names) <= _MOST_FIELDS or not {"x", "y", "z"} <= set(names):
        raise refused(path, f"has the fields {' '.join(names[:8]) or 'none'}", "x, y and z among them")
    sizes, counts = _numbers(lines, "SIZE", path), _numbers(lines, "COUNT", path, (1,) * len(names))
    kinds = lines.get("TYPE", [])
    if not len(names) == len(sizes) == len(counts) == len(kinds):
        raise refused(path, "has FIELDS, SIZE, TYPE and COUNT of different lengths", "the same")
    types = [_TYPES.get(pair, "") for pair in zip(kinds, sizes, strict=True)]
    if not all(types) or not all(1 <= count <= _MOST_COUNT for count in counts):
        raise refused(path, "has fields of an unknown type", "F 4 or 8, U or I 1, 2, 4 or 8")
    if any(counts[names.index(axis)] != 1 for axis in "xyz"):
        raise refused(path, "has several values in x, y or z", "one each")
    width, height = (next(iter(_numbers(lines, name, path)), 0) for name in ("WIDTH", "HEIGHT"))
    if height < 1 or width < 1:
        raise refused(path, f"has {width} by {height} points", "at least one: lines WIDTH and HEIGHT")
    if width * height > MOST_POINTS:
        raise refused(path, f"has {width} by {height} points", f"at most {MOST_POINTS}")
    form = " ".join(lines["DATA"]).lower()
    if form not in _FORMS:
        raise refused(path, f"has data of the form {form[:40]!r}", ", ".join(_FORMS))
    return _Header(names, tuple(types), counts, width, height, form, begin)


def _numbers(lines: dict[str, list[str]], name: str, path: Path, otherwise: tuple[int, ...] = ()) -> tuple[int, ...]:
    words = lines.get(name)
    if words is None:
        return otherwise
    if not all(word.isascii() and word.isdigit() and len(word) <= 9 for word in words):
        raise refused(path, f"has a line {name} {' '.join(words)[:40]}", "whole numbers")
    return tuple(int(word) for word in words)


def _most_bytes(head: _Header) -> int:
    # a number in words is at most 32 characters here; compressed data may be larger than the data by a 32th
    return 32 * sum(head.counts) if head.form == "ascii" else head.record.itemsize + head.record.itemsize // 8 + 16


def _fields(data: bytes, head: _Header, path: Path) -> dict[str, NDArray[np.generic]]:
    """Return the fields (n,) of one value by name."""
    count, record = head.width * head.height, head.record
    if head.form == "ascii":
        return _words(data, head, path)
    wanted = count * record.itemsize
    if head.form == "binary":
        if len(data) < wanted:
            raise refused(path, f"ends after {len(data)} of {wanted} bytes of data", "all of them")
        table = np.frombuffer(data, record, count)
        return {name: table[f"f{i}"][:, 0].copy() for i, name in enumerate(head.names) if head.counts[i] == 1}
    if len(data) < 8:
        raise refused(path, f"ends after {len(data)} bytes of data", "at least 8")
    packed, unpacked = (int(size) for size in np.frombuffer(data, "<u4", 2))
    if unpacked != wanted or len(data) < 8 + packed:
        raise refused(
            path, f"says {unpacked} bytes in {packed}, and {len(data) - 8} are there", f"{wanted} bytes, and all there"
        )
    raw = np.empty(wanted, np.uint8)
    if unpack_lzf(np.frombuffer(data, np.uint8, packed, 8), raw) != wanted:
        raise refused(path, "has compressed data that are damaged", "LZF")
    out: dict[str, NDArray[np.generic]] = {}
    at = 0
    for name, kind, number in zip(head.names, head.types, head.counts, strict=True):
        size = np.dtype(kind).itemsize * number * count
        if number == 1:
            out[name] = raw[at : at + size].view(kind)
        at += size
    return out


def _words(data: bytes, head: _Header, path: Path) -> dict[str, NDArray[np.generic]]:
    count, columns = head.width * head.height, sum(head.counts)
    words = data.split()
    if len(words) < count * columns:
        raise refused(path, f"ends after {len(words)} of {count * columns} values", "all of them")
    out: dict[str, NDArray[np.generic]] = {}
    at = 0
    try:
        for name, kind, number in zip(head.names, head.types, head.counts, strict=True):
            if number == 1:
                column = np.array(words[at : count * columns : columns])
                # colours are packed in a float whose digits do not matter, or in a whole number
                out[name] = column.astype(np.float64).astype(kind)
            at += number
    except (ValueError, OverflowError) as error:
        raise refused(path, "has a value that is no number", "numbers with a decimal point, or nan") from error
    return out


@kernel
def unpack_lzf(data: Bytes, out: Bytes) -> int:
    """Unpack LZF data; return how many bytes were written, -1 for data that are damaged.

    Args:
        data: (n,) as libLZF (Marc Lehmann) packs it.
        out: (m,) is written to; what does not fit is damage.
    """
    i = j = 0
    n, m = len(data), len(out)
    while i < n:
        control = int(data[i])
        i += 1
        if control < 32:
            length = control + 1
            if i + length > n or j + length > m:
                return -1
            for _ in range(length):
                out[j] = data[i]
                i += 1
                j += 1
            continue
        length = control >> 5
        if length == 7:
            if i >= n:
                return -1
            length += int(data[i])
            i += 1
        if i >= n:
            return -1
        at = j - ((control & 31) << 8) - int(data[i]) - 1
        i += 1
        length += 2
        if at < 0 or j + length > m:
            return -1
        for _ in range(length):
            out[j] = out[at]
            j += 1
            at += 1
    return j
