# SPDX-License-Identifier: Apache-2.0
"""Clouds in PLY files: the vertices; ascii or binary, either byte order.

Format: https://paulbourke.net/dataformats/ply/. A cloud is organised where the file says so: lines `obj_info num_cols`
and `obj_info num_rows`, with an element `range_grid` of the numbers of its points as range scanners and PCL write them,
or with a vertex per pixel; or the element `camera` of PCL.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from openarm_common.kernels import kernel
from openarm_common.printable import brief
from openarm_common.types import Bytes, Ints
from openarm_perception.frames.cloud_fields import MOST_POINTS, Cloud, cloud_of, refused

#: Most bytes of a header, elements, and properties of an element.
_MOST_HEADER, _MOST_ELEMENTS, _MOST_PROPERTIES = 65536, 32, 128
_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
_FORMS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class _Element:
    """Its name, how many there are, and for each property its name, its type, and the type of its length, "" of one."""

    name: str
    count: int
    properties: tuple[tuple[str, str, str], ...]

    @property
    def lists(self) -> bool:
        return any(length for _, _, length in self.properties)


@dataclass(frozen=True)
class _Header:
    """What a header says: form, elements, `num_cols` and `num_rows`, 0 without them, and the grid of that size."""

    order: str
    ascii: bool
    elements: tuple[_Element, ...]
    width: int
    height: int
    grid: _Element | None


def read_ply(path: Path) -> Cloud:
    """Read a cloud.

    Raises:
        OpenArmError: BAD_IMAGE, for what is no PLY file, is cut short, has no x, y, z, or has more than MOST_POINTS
            points.
    """
    try:
        data: Bytes = np.memmap(path, np.uint8, "r")
    except (OSError, ValueError) as error:  # an empty file can't be mapped
        what = f"can't be read: {error.strerror}" if isinstance(error, OSError) else "is empty"
        raise refused(path, what, "a PLY file") from error
    head, at = _header(data, path)
    tables: dict[str, dict[str, NDArray[Any]]] = {}
    grid: Ints | None = None
    for element in head.elements:
        if head.grid is element and "vertex" in tables:
            grid = _grid(data[at:], head, element, path)
            break
        columns, size = _columns(data[at:], head, element, path)
        tables[element.name] = columns
        at += size
    fields, count = tables["vertex"], len(tables["vertex"]["x"])
    if grid is not None:
        return _gridded(fields, grid, head, count, path)
    camera = tables.get("camera", {})
    sizes = [(head.height, head.width)]
    if "viewportx" in camera and "viewporty" in camera and len(camera["viewportx"]) == 1:
        sizes.append((int(np.nan_to_num(camera["viewporty"][0])), int(np.nan_to_num(camera["viewportx"][0]))))
    shape = next((size for size in sizes if size[0] * size[1] == count and min(size) > 1), (1, count))
    return cloud_of(fields, shape)


def _gridded(fields: dict[str, NDArray[Any]], grid: Ints, head: _Header, count: int, path: Path) -> Cloud:
    """Return the cloud of points that a grid of their numbers, -1 for none, puts into an image."""
    if grid.max(initial=-1) >= count or grid.min(initial=0) < -1:
        raise refused(path, f"has numbers of points beyond its {count} in range_grid", "0 or more, and fewer")
    flat = cloud_of(
        {name: np.append(column, column.dtype.type(0))[grid] for name, column in fields.items()}, (1, len(grid))
    )
    flat.points[0, grid < 0] = np.nan
    shape = (head.height, head.width)
    return Cloud(
        flat.points.reshape(*shape, 3),
        None if flat.rgb is None else flat.rgb.reshape(*shape, 3),
        None if flat.label is None else flat.label.reshape(shape),
    )


def _header(data: Bytes, path: Path) -> tuple[_Header, int]:
    """Return the header and where the data begin."""
    found = re.match(rb"ply\s(.*?)\bend_header[ \t]*(?:\r\n|\n|\r)", data[:_MOST_HEADER].tobytes(), re.DOTALL)
    if found is None:
        raise refused(path, f"has no 'ply' .. 'end_header' within {_MOST_HEADER} bytes", "a PLY file")
    elements: list[tuple[str, int, list[tuple[str, str, str]]]] = []
    form, said = "", {"num_cols": 0, "num_rows": 0}
    for line in found[1].decode("ascii", errors="replace").splitlines():
        match line.split():
            case ["format", form, *_]:
                pass
            case ["obj_info", ("num_cols" | "num_rows") as name, number]:
                said[name] = _number(number, line, path)
            case ["element", name, number]:
                elements.append((name, _number(number, line, path), []))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(_TYPES):
                elements[-1][2].append((name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name] if elements and kind in _TYPES:
                elements[-1][2].append((name.lower(), _TYPES[kind], ""))
            case ["property", *_]:
                raise refused(path, f"has the line {brief(line)}", f"a property of the types {', '.join(_TYPES)}")
            case _:
                pass  # comments, and what others add
    if form not in _FORMS:
        raise refused(path, f"has the format {brief(form)}", ", ".join(_FORMS))
    made = tuple(_Element(name, count, tuple(properties)) for name, count, properties in elements)
    vertex = next((element for element in made if element.name == "vertex"), None)
    names = [] if vertex is None else [name for name, _, length in vertex.properties if not length]
    if vertex is None or not {"x", "y", "z"} <= set(names):
        raise refused(path, f"has vertices with {' '.join(names[:8]) or 'nothing'}", "x, y and z among them")
    if not 1 <= vertex.count <= MOST_POINTS:
        raise refused(path, f"has {vertex.count} vertices", f"1 to {MOST_POINTS}")
    if len({one.name for one in made}) < len(made):
        raise refused(path, "has two elements of one name", "each once")
    if len(made) > _MOST_ELEMENTS or any(len(one.properties) > _MOST_PROPERTIES for one in made):
        text = f"at most {_MOST_ELEMENTS} elements of {_MOST_PROPERTIES} properties"
        raise refused(path, f"has {len(made)} elements", text)
    width, height = said["num_cols"], said["num_rows"]
    # the grid of a single row says nothing, and some announce it without writing it
    gridded = min(width, height) > 1
    grids = (one for one in made if one.name == "range_grid" and one.lists and one.count == width * height)
    grid = next(grids, None) if gridded else None
    last = max(i for i, one in enumerate(made) if one.name in ("vertex", "camera") or one is grid)
    space = b"\r\n\t " if form == "ascii" else b""
    at = found.end()
    while at < len(data) and data[at] in space:
        at += 1
    return _Header(_FORMS[form], form == "ascii", made[: last + 1], width, height, grid), at


def _number(word: str, line: str, path: Path) -> int:
    if not (word.isascii() and word.isdigit() and len(word) <= 12):
        raise refused(path, f"has the line {brief(line)}", "a whole number at its end")
    return int(word)


def _columns(data: Bytes, head: _Header, element: _Element, path: Path) -> tuple[dict[str, NDArray[Any]], int]:
    """Return the properties (n,) of an element of one value by name, and its bytes; those with lists are skipped."""
    names = [name for name, _, _ in element.properties]
    if element.lists:
        if element.name == "vertex":
            raise refused(path, "has lists among the properties of its vertices", "single values")
        return {}, _ends(data, head, element, path)[1]
    if head.ascii:
        size = _lines(data, element, path)
        values = _words(data[:size], path)
        if len(values) != element.count * len(names):
            what = f"has {len(values)} values for {element.count} {element.name} of {len(names)}"
            raise refused(path, what, "one line of values for each")
        table = values.reshape(element.count, len(names))
        with np.errstate(invalid="ignore", over="ignore"):
            return {name: table[:, i].astype(kind) for i, (name, kind, _) in enumerate(element.properties)}, size
    if not names:
        return {}, 0
    record = np.dtype([(f"f{i}", head.order + kind) for i, (_, kind, _) in enumerate(element.properties)])
    size = element.count * record.itemsize
    if len(data) < size:
        raise refused(path, f"ends after {len(data)} of {size} bytes of {element.name}", "all of them")
    rows = data[:size].view(record)
    return {name: rows[f"f{i}"].astype(kind) for i, (name, kind, _) in enumerate(element.properties)}, size


def _words(text: Bytes, path: Path) -> NDArray[np.float64]:
    try:
        return np.fromstring(text.tobytes().decode("ascii", errors="replace"), np.float64, sep=" ")
    except (ValueError, DeprecationWarning) as error:
        raise refused(path, "has a value that is no number", "numbers with a decimal point, or nan") from error


def _lines(data: Bytes, element: _Element, path: Path) -> int:
    """Return the bytes of the lines of an element, one for each."""
    ends = np.flatnonzero(data == ord("\n"))
    if len(ends) < element.count - 1:  # the last line may have no end
        raise refused(path, f"ends after {len(ends)} of {element.count} lines of {element.name}", "all of them")
    return 0 if element.count == 0 else int(np.append(ends, len(data) - 1)[element.count - 1]) + 1


def _ends(data: Bytes, head: _Header, element: _Element, path: Path) -> tuple[Ints, int]:
    """Return where the last list of each row of a binary element begins, -1 where it is empty, and its bytes."""
    if head.ascii:
        return np.empty(0, np.int64), _lines(data, element, path)
    if element.count > len(data):
        raise refused(path, f"ends in the middle of {element.name}", "all of it")
    sizes = [np.dtype(kind).itemsize for _, kind, _ in element.properties]
    lengths = [np.dtype(length).itemsize if length else 0 for _, _, length in element.properties]
    first: Ints = np.empty(element.count, np.int64)
    used = int(walk(data, np.array(sizes), np.array(lengths), head.order == ">", first))
    if used < 0:
        raise refused(path, f"ends in the middle of {element.name}", "all of it")
    return first, used


def _grid(data: Bytes, head: _Header, element: _Element, path: Path) -> Ints:
    """Return the number of the point of each cell, -1 where there is none."""
    if head.ascii:
        words = _words(data[: _lines(data, element, path)], path)
        numbers: Ints = np.full(element.count, -1, np.int64)
        if not pick(words, numbers):
            raise refused(path, "has a range_grid that is damaged", "0, or 1 and the number of a point, for each cell")
        return numbers
    first, _ = _ends(data, head, element, path)
    kind = np.dtype(head.order + element.properties[-1][1])
    there = np.flatnonzero(first >= 0)
    numbers = np.full(element.count, -1, np.int64)
    bytes_of = data[first[there, None] + np.arange(kind.itemsize)]
    numbers[there] = np.ascontiguousarray(bytes_of).view(kind)[:, 0].astype(np.int64)
    return numbers


@kernel
def walk(data: Bytes, sizes: Ints, lengths: Ints, big: bool, first: Ints) -> int:
    """Walk over the rows of a binary element with lists.

    Args:
        data: (n,) from its first row on.
        sizes: (k,) bytes of a value of each property.
        lengths: (k,) bytes of the length of each list, 0 for a single value.
        big: Whether the most significant byte comes first.
        first: (rows,) filled: where the values of the last list of each row begin, -1 where it is empty.

    Returns:
        Bytes of the rows, -1 where the data end too early.
    """
    at = 0
    for row in range(first.size):
        first[row] = -1
        for i in range(sizes.size):
            number = 1
            if lengths[i] > 0:
                if at + lengths[i] > data.size:
                    return -1
                number = 0
                for b in range(lengths[i]):
                    number = number << 8 | np.int64(data[at + (b if big else lengths[i] - 1 - b)])
                at += lengths[i]
                first[row] = at if number > 0 else -1
            at += number * sizes[i]
            if at > data.size:
                return -1
    return at


@kernel
def pick(words: NDArray[np.float64], numbers: Ints) -> bool:
    """Fill `numbers` (cells,) with the first value of each list, where it is not empty; return whether all is sound."""
    at = 0
    for cell in range(numbers.size):
        if at >= words.size or not 0.0 <= words[at] <= 16.0:
            return False
        length = int(words[at])
        if at + length >= words.size:
            return False
        if length > 0:
            if not -1.0 <= words[at + 1] <= 1e9:
                return False
            numbers[cell] = int(words[at + 1])
        at += 1 + length
    return True
