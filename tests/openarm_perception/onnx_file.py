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


#: Of the type of a tensor.
KINDS = {np.dtype(np.float32): 1, np.dtype(np.uint8): 2, np.dtype(np.int64): 7, np.dtype(np.float16): 10}


def write_network(
    path: Path,
    output: np.ndarray | dict[str, np.ndarray],
    shape: tuple[int | str, ...] = (1, 3, 256, 320),
    names: str = "{0: 'box', 1: 'ball'}",
    kind: int = 1,
    metadata: dict[str, str] | None = None,
    second: str = "",
) -> Path:
    """A file whose output is `output` for every input of `shape` (kind 1: float).

    Several outputs have names, and types of their own; one alone is of floats. A `second` input is two integers.
    """
    outputs = output if isinstance(output, dict) else {"output0": np.asarray(output, np.float32)}
    graph = b""
    for name, value in outputs.items():
        data = np.ascontiguousarray(value)
        head = b"".join(field(1, d) for d in data.shape) + field(2, KINDS[data.dtype])
        graph += field(1, field(1, b"is_" + name.encode()) + field(2, name.encode()) + field(4, b"Identity"))
        graph += field(5, head + field(8, b"is_" + name.encode()) + field(9, data.tobytes()))
        graph += field(12, field(1, name.encode()) + field(2, tensor_type(data.shape, KINDS[data.dtype])))
    graph += field(2, b"graph") + field(11, field(1, b"images") + field(2, tensor_type(shape, kind)))
    if second:
        graph += field(11, field(1, second.encode()) + field(2, tensor_type((1, 2), 7)))
    model = field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 17))
    for key, value in {**({"names": names} if names else {}), **(metadata or {})}.items():
        model += field(14, field(1, key.encode()) + field(2, value.encode()))
    path.write_bytes(model)
    return path


def boxes(*rows: tuple[float, ...], cells: int = 100, classes: int = 2) -> np.ndarray:
    """An output (1, 4 + classes, cells) with rows of left, top, right, bottom, class, score in input pixels."""
    out = np.zeros((1, 4 + classes, cells), np.float32)
    for i, (left, top, right, bottom, kind, score) in enumerate(rows):
        out[0, :4, i] = ((left + right) / 2, (top + bottom) / 2, right - left, bottom - top)
        out[0, 4 + int(kind), i] = score
    return out
