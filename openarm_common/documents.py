# SPDX-License-Identifier: Apache-2.0
"""Files of numbers as nested lists and mappings: YAML, JSON, OpenCV's FileStorage, NumPy's arrays, tables of text."""

from __future__ import annotations

import csv
import io
import math
import re
import zipfile
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import Any

import numpy as np

from openarm_common.config import MAX_YAML_BYTES, parse_json, parse_yaml, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

#: Largest file of arrays, bytes, and most numbers of one.
_LARGEST, _MOST_NUMBERS = 64 * 2**20, 10**6
#: Beginnings of lines that say something of a table; and a decimal comma.
_COMMENT = ("#", "%", "//")
_BRACKETS = re.compile(r"\b[XYZABC]\s+(?=[-+.\d])|\bp(?=\[)|[\[\](){}]")
_DECIMAL = re.compile(r"^([-+]?\d+),(\d+(?:[eE][-+]?\d+)?)$")
TABLES = (".csv", ".tsv", ".txt", ".tum", ".dat")
DOCUMENTS = (".yaml", ".yml", ".json", ".jsonl", ".xml", ".samples", ".npz", ".npy")


@dataclass(frozen=True, eq=False)
class Cells:
    """A table of text.

    Args:
        header: (k,) names of columns; () where the file has none.
        rows: Cells of each line.
        lines: Number of each line in the file.
    """

    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    lines: tuple[int, ...]


def read_document(path: Path) -> Any:
    """Read a file as nested lists, mappings and arrays.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file and what is wrong.
    """
    if path.suffix in (".npz", ".npy"):
        return _arrays(path)
    text = _decoded(path)
    if path.suffix == ".xml":
        return _storage_xml(text, str(path))
    if path.suffix in (".json", ".jsonl"):
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) > 1 and all(line.strip()[:1] in "{[" and line.strip()[-1:] in "}]" for line in lines):
            return [parse_json(line, f"{path}:{k + 1}", Code.CONFIG_INVALID) for k, line in enumerate(lines)]
        return parse_json(text, str(path), Code.CONFIG_INVALID)
    # FileStorage has a directive that is no YAML, and tags for its matrices
    plain = re.sub(r"\A%YAML[: ]1\.\d\s*(\n---)?", "", text).replace("!!opencv-matrix", "")
    parts = [part for part in re.split(r"^---\s*$", plain, flags=re.MULTILINE) if part.strip()]
    if len(parts) < 2:  # else it is a stream of messages, as ROS prints them
        return parse_yaml(parts[0] if parts else "", str(path))
    return [parse_yaml(part, str(path)) for part in parts]


def _decoded(path: Path) -> str:
    """Return the text of a file in UTF-8, or in what spreadsheets write."""
    try:
        with path.open("rb") as file:
            head = file.read(MAX_YAML_BYTES)
        if head[:2] in (b"\xff\xfe", b"\xfe\xff"):
            return path.read_text("utf-16")
        if not _is_utf8(head) and b"\0" not in head:
            return head.decode("latin-1")
        return read_text(path).removeprefix("\ufeff")
    except (OSError, UnicodeError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"can't read {path}: {type(error).__name__}") from error


def _is_utf8(content: bytes) -> bool:
    try:
        content.decode()
    except UnicodeDecodeError:
        return False
    return True


def _arrays(path: Path) -> dict[str, Any]:
    """Read arrays of numbers; objects are not unpickled."""
    try:
        if path.stat().st_size > _LARGEST:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} is larger than {_LARGEST // 2**20} MiB")
        data = io.BytesIO(path.read_bytes())
        if path.suffix == ".npz":
            with zipfile.ZipFile(data) as archive:
                packed = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
                if sum(info.file_size for info in packed.values()) > _LARGEST:
                    raise OpenArmError(Code.CONFIG_INVALID, f"{path} unpacks to more than {_LARGEST // 2**20} MiB")
                read = {name: _array(archive.read(info)) for name, info in packed.items()}
        else:
            read = {path.stem: _array(data.getvalue())}
    except (OSError, ValueError, KeyError, EOFError, TypeError, zipfile.BadZipFile, RuntimeError, OverflowError,
            NotImplementedError, SyntaxError, MemoryError, TokenError) as error:  # fmt: skip
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path} holds no arrays of numbers that can be read: {type(error).__name__}"
        ) from error
    # names that NumPy gives count the arrays, not records
    plain = {
        name: re.sub(r"^arr_(\d+)$", lambda found: f"array {'abcdefghij'[int(found[1]) % 10]}", name) for name in read
    }
    return {plain[name]: value for name, value in read.items() if value is not None}


def _array(data: bytes) -> Any:
    header = data[:1024]
    if (shape := re.search(rb"'shape': \(([\d, ]*)\)", header)) is not None:
        counts = [int(part) for part in shape[1].split(b",") if part.strip()]
        if math.prod(counts) > _MOST_NUMBERS:
            return None
    value: Any = np.load(io.BytesIO(data), allow_pickle=False)
    return value.astype(np.float64) if value.dtype.kind in "fiu" else None


def _storage_xml(text: str, where: str) -> Any:
    """Return what FileStorage writes as XML."""
    from xml.etree import ElementTree

    if "<!ENTITY" in text or "<!DOCTYPE" in text:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where} has a document type, which is not read")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{where} is not valid XML: {brief(str(error))}") from error

    def value(node: ElementTree.Element, depth: int = 0) -> Any:
        if depth > 30:
            raise OpenArmError(Code.CONFIG_INVALID, f"{where} is nested too deeply")
        children = list(node)
        if children and all(child.tag == "_" for child in children):
            return [value(child, depth + 1) for child in children]
        if children:
            return {child.tag: value(child, depth + 1) for child in children}
        words = (node.text or "").split()
        numbers = [number(word) for word in words]
        if words and all(one is not None for one in numbers):
            return numbers if len(numbers) > 1 else numbers[0]
        return " ".join(words)

    return value(root)


#: What stands for no number in a table, and units behind one.
_NONE = ("", "nan", "none", "null", "-", "n/a", "na", "inf")
_WITH_UNIT = re.compile(r"([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(?:mm|cm|m|deg|rad|°)")


def number(text: Any) -> float | None:
    """Return a finite number, or None."""
    if isinstance(text, bool):
        return None
    if isinstance(text, str) and (found := _WITH_UNIT.fullmatch(text)):
        text = found[1]
    try:
        value = float(text)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if math.isfinite(value) else None


def is_missing(cell: str) -> bool:
    """Return whether a cell stands for a number that is not there."""
    return cell.lower() in _NONE


def read_cells(path: Path) -> Cells:
    """Read a table: commas, semicolons, tabs or blanks separate; a first line of words is its header.

    Raises:
        OpenArmError: CONFIG_INVALID.
    """
    numbered = [(k + 1, line.strip()) for k, line in enumerate(_decoded(path).splitlines())]
    said = [line.lstrip("#%/ ") for _, line in numbered if line.startswith(_COMMENT)]
    numbered = [(k, line) for k, line in numbered if line and not line.startswith((*_COMMENT, "sep="))]
    # brackets of lists, and of what robots print: p[x, y, ...], {X 1.0, Y 2.0, ...}
    plain: list[tuple[int, str]] = []
    for k, line in numbered:
        bare = _BRACKETS.sub(" ", line)
        plain.append((k, bare.strip(" ,;") if bare != line else line))
    plain = [(k, line) for k, line in plain if line]
    lines = [line for _, line in plain]
    split = next((mark for mark in (";", "\t", ",") if len(lines) and all(mark in line for line in lines[-3:])), None)

    def cells(line: str) -> tuple[str, ...]:
        parts = next(csv.reader([line], delimiter=split)) if split else line.split()
        out = (part.strip() for part in parts)
        return tuple(_DECIMAL.sub(r"\1.\2", part) for part in out) if split in (";", "\t") else tuple(out)

    try:
        rows = [(k, cells(line)) for k, line in plain]
    except (csv.Error, StopIteration) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} is no table: {error}") from error
    # a comma at the end of each line makes a cell of nothing; a first line of one number says how many there are
    if rows and all(not row[-1] for _, row in rows):
        rows = [(k, row[:-1]) for k, row in rows]
    if len(rows) > 1 and len(rows[0][1]) == 1 < len(rows[1][1]):
        rows = rows[1:]
    header: tuple[str, ...] = ()
    if rows and sum(number(cell) is None and not is_missing(cell) for cell in rows[0][1]) > 1:
        header, rows = rows[0][1], rows[1:]
    elif said and rows and len(cells(said[-1])) == len(rows[0][1]):  # TUM's, and NumPy's
        header = cells(said[-1])
    return _in_blocks(Cells(header, tuple(row for _, row in rows), tuple(k for k, _ in rows)))


def _in_blocks(table: Cells) -> Cells:
    """Return a table of 4x4 matrices, a row a line, with a matrix a line."""
    rows = table.rows
    last = ("0", "0", "0", "1")
    if not rows or len(rows) % 4 or {len(row) for row in rows} != {4}:
        return table
    if any(tuple(f"{value:g}" for cell in row if (value := number(cell)) is not None) != last for row in rows[3::4]):
        return table
    whole = tuple(sum(rows[k : k + 4], ()) for k in range(0, len(rows), 4))
    return Cells((), whole, table.lines[::4])
