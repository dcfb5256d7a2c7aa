# SPDX-License-Identifier: Apache-2.0
"""ONNX files of "networks" that always give the same output, written by hand: tests need neither torch nor onnx."""

from __future__ import annotations

from pathlib import Path

import numpy as np


def varint(number: int) -> bytes:
    out = b""
    while number > 0x7F:
        out += bytes([number & 0x7F | 0x80])
        number >>= 7
    return out + bytes([number])


def field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def tensor_type(shape: tuple[int | str, ...], kind: int) -> bytes:
    dims = b"".join(field(1, field(1, d) if isinstance(d, int) else field(2, d.encode())) for d in shape)
    return field(1, field(1, kind) + field(2, dims))


def write_network(
    path: Path,
    output: np.ndarray,
    shape: tuple[int | str, ...] = (1, 3, 256, 320),
    names: str = "{0: 'box', 1: 'ball'}",
    kind: int = 1,
) -> Path:
    """A file whose output is `output` for every input of `shape` (kind 1: float)."""
    output = np.ascontiguousarray(output, np.float32)
    constant = (
        b"".join(field(1, d) for d in output.shape) + field(2, 1) + field(8, b"always") + field(9, output.tobytes())
    )
    node = field(1, b"always") + field(2, b"output0") + field(4, b"Identity")
    graph = field(1, node) + field(2, b"graph") + field(5, constant)
    graph += field(11, field(1, b"images") + field(2, tensor_type(shape, kind)))
    graph += field(12, field(1, b"output0") + field(2, tensor_type(output.shape, 1)))
    model = field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 17))
    if names:
        model += field(14, field(1, b"names") + field(2, names.encode()))
    path.write_bytes(model)
    return path


def boxes(*rows: tuple[float, ...], cells: int = 100, classes: int = 2) -> np.ndarray:
    """An output (1, 4 + classes, cells) with rows of left, top, right, bottom, class, score in input pixels."""
    out = np.zeros((1, 4 + classes, cells), np.float32)
    for i, (left, top, right, bottom, kind, score) in enumerate(rows):
        out[0, :4, i] = ((left + right) / 2, (top + bottom) / 2, right - left, bottom - top)
        out[0, 4 + int(kind), i] = score
    return out
