# SPDX-License-Identifier: Apache-2.0
"""Wavefront OBJ files of others: vertices, texture coordinates and triangles by group, all of it bounded."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array, Ints

#: Longest file, bytes; most vertices and triangles; most corners of a face.
MAX_BYTES, MAX_VERTICES, MAX_TRIANGLES, MAX_CORNERS = 32 * 2**20, 300_000, 600_000, 256


@dataclass(frozen=True, eq=False)
class ObjMesh:
    """What an OBJ file holds.

    Attributes:
        vertices: (n, 3), in the units of the file.
        uv: (k, 2) texture coordinates; k = 0 without.
        triangles: (m, 3) indices of vertices.
        uv_triangles: (m, 3) indices of `uv`; -1 where a corner has none.
        groups: (m,) number of the `o` or `g` that a triangle belongs to.
        names: Names of the groups.
        materials: File of the materials (`mtllib`); "" without.
    """

    vertices: Array
    uv: Array
    triangles: Ints
    uv_triangles: Ints
    groups: Ints
    names: tuple[str, ...]
    materials: str


def read_obj(path: Path) -> ObjMesh:
    """Read an OBJ file; faces of more than three corners become fans.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the line, for what is missing, no OBJ, too large or not finite.
    """
    points, uv, faces, uv_faces, groups = [], [], [], [], list[int]()
    names, materials, group = [""], "", 0
    for number, line in enumerate(read_text(path, Code.CONFIG_INVALID, MAX_BYTES).splitlines(), 1):
        word, _, rest = line.strip().partition(" ")
        try:
            if word == "v":
                points.append(_numbers(rest, 3))
            elif word == "vt":
                uv.append(_numbers(rest, 2))
            elif word in ("o", "g"):
                names.append(rest.strip())
                group = len(names) - 1
            elif word == "f":
                corners = [_corner(text, len(points), len(uv)) for text in rest.split()]
                if not 3 <= len(corners) <= MAX_CORNERS:
                    raise ValueError(f"a face of {len(corners)} corners, expected 3 to {MAX_CORNERS}")
                for k in range(1, len(corners) - 1):
                    three = (corners[0], corners[k], corners[k + 1])
                    faces.append([corner[0] for corner in three])
                    uv_faces.append([corner[1] for corner in three])
                    groups.append(group)
            elif word == "mtllib" and not materials:
                materials = rest.strip()
        except ValueError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"{path}, line {number}: {error}") from error
        if len(points) > MAX_VERTICES or len(faces) > MAX_TRIANGLES:
            text = f"more than {MAX_VERTICES} vertices or {MAX_TRIANGLES} triangles; simplify the mesh"
            raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {text}")
    if not faces:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no face; expected an OBJ file with `v` and `f` lines")
    return ObjMesh(
        np.array(points, np.float64).reshape(-1, 3),
        np.array(uv, np.float64).reshape(-1, 2),
        np.array(faces, np.int64),
        np.array(uv_faces, np.int64),
        np.array(groups, np.int64),
        tuple(names),
        materials,
    )


def _numbers(text: str, count: int) -> list[float]:
    found = [float(word) for word in text.split()[:count]]
    if len(found) < count or not np.isfinite(found).all():
        raise ValueError(f"{brief(text)}, expected {count} finite numbers")
    return found


def _corner(text: str, vertices: int, coordinates: int) -> tuple[int, int]:
    """Return the indices of vertex and texture coordinate (-1: none) of `v`, `v/vt`, `v//vn` or `v/vt/vn`."""
    parts = text.split("/")
    return _index(parts[0], vertices), _index(parts[1], coordinates) if len(parts) > 1 and parts[1] else -1


def _index(text: str, count: int) -> int:
    index = int(text)
    index = index - 1 if index > 0 else count + index
    if not 0 <= index < count:
        raise ValueError(f"index {brief(text)} of {count} that are there so far")
    return index


def obj_text(vertices: Array, parts: Sequence[tuple[str, Ints]], header: Sequence[str] = ()) -> str:
    """Write triangles as groups of an OBJ file.

    Args:
        vertices: (n, 3) m.
        parts: Name and triangles (m, 3) of each group.
        header: Lines before the vertices, such as comments.
    """
    lines = [*header, *(f"v {x:.5g} {y:.5g} {z:.5g}" for x, y, z in vertices.tolist())]
    for name, triangles in parts:
        lines += [f"o {name}", *(f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist())]
    return "\n".join(lines) + "\n"
