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


def write_endless(path: Path, *, growing: bool) -> Path:
    """A file whose only node is a Loop without an end; `growing` doubles what it carries each time."""

    def node(kind: str, ins: tuple[str, ...], out: str, *attributes: bytes) -> bytes:
        named = b"".join(field(1, name.encode()) for name in ins) + field(2, out.encode()) + field(4, kind.encode())
        return field(1, named + b"".join(field(5, attribute) for attribute in attributes))

    def value(number: int, name: str, shape: tuple[int | str, ...], kind: int) -> bytes:
        return field(number, field(1, name.encode()) + field(2, tensor_type(shape, kind)))

    axis = field(1, b"axis") + field(3, 0) + field(20, 2)
    body = node("Concat", ("x", "x"), "y", axis) if growing else node("Identity", ("x",), "y")
    body += node("Identity", ("on",), "still_on") + field(2, b"body")
    body += value(11, "i", (), 7) + value(11, "on", (), 9) + value(11, "x", ("n",), 1)
    body += value(12, "still_on", (), 9) + value(12, "y", ("m",), 1)
    graph = node("Loop", ("", "true", "start"), "output0", field(1, b"body") + field(6, body) + field(20, 5))
    graph += field(2, b"graph") + value(11, "images", (1, 3, 256, 320), 1) + value(12, "output0", ("k",), 1)
    graph += field(5, field(2, 9) + field(8, b"true") + field(9, b"\1"))
    graph += field(5, field(1, 100) + field(2, 1) + field(8, b"start") + field(9, bytes(400)))
    path.write_bytes(field(1, 8) + field(7, graph) + field(8, field(1, b"") + field(2, 17)))
    return path
