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

from openarm_common.config import parse_json, parse_yaml, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

#: Largest file of arrays, bytes, and most numbers of one.
_LARGEST, _MOST_NUMBERS = 64 * 2**20, 10**6
TABLES = (".csv", ".tsv", ".txt", ".tum", ".dat")
DOCUMENTS = (".yaml", ".yml", ".json", ".xml", ".samples", ".npz", ".npy")


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
    text = read_text(path)
    if path.suffix == ".json":
        return parse_json(text, str(path), Code.CONFIG_INVALID)
    if path.suffix == ".xml":
        return _storage_xml(text, str(path))
    # FileStorage has a directive that is no YAML, and tags for its matrices
    plain = re.sub(r"\A%YAML:1\.0\s*(\n---)?", "", text)
    return parse_yaml(plain.replace("!!opencv-matrix", ""), str(path))


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
    return {name: value for name, value in read.items() if value is not None}


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


def number(text: Any) -> float | None:
    """Return a finite number, or None."""
    if isinstance(text, bool):
        return None
    try:
        value = float(text)
    except (TypeError, ValueError, OverflowError):
        return None
    return value if math.isfinite(value) else None


def read_cells(path: Path) -> Cells:
    """Read a table: commas, semicolons, tabs or blanks separate; a first line of words is its header.

    Raises:
        OpenArmError: CONFIG_INVALID.
    """
    text = read_text(path)
    numbered = [(k + 1, line.strip()) for k, line in enumerate(text.splitlines())]
    said = [line.lstrip("#").strip() for _, line in numbered if line.startswith("#")]
    numbered = [(k, line) for k, line in numbered if line and not line.startswith("#")]
    split = next((mark for mark in (",", ";", "\t") if numbered and mark in numbered[-1][1]), None)

    def cells(line: str) -> tuple[str, ...]:
        parts = next(csv.reader([line], delimiter=split)) if split else line.split()
        return tuple(part.strip() for part in parts)

    try:
        rows = [(k, cells(line)) for k, line in numbered]
    except csv.Error as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} is no table: {error}") from error
    # a comma at the end of each line, or between values and blanks, makes a cell of nothing
    if rows and all(not row[-1] for _, row in rows):
        rows = [(k, row[:-1]) for k, row in rows]
    header: tuple[str, ...] = ()
    if rows and sum(number(cell) is None for cell in rows[0][1]) > 1:
        header, rows = rows[0][1], rows[1:]
    elif said and rows and len(cells(said[-1])) == len(rows[0][1]):  # TUM's, and NumPy's
        header = cells(said[-1])
    return Cells(header, tuple(row for _, row in rows), tuple(k for k, _ in rows))
