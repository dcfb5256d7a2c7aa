# SPDX-License-Identifier: Apache-2.0
"""Other robots: a URDF whose collision shapes are meshes, read with boxes that hold them. m, link axes.

Both collision layers work on primitives. A mesh is cut along its longest side, again and again while that saves room,
and each piece gets the box about it; no point of the mesh is left outside.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import coal
import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: A cut must make the boxes smaller by this share in all, and there are so many cuts in a row at most.
_SAVED = 0.12
_CUTS = 3
#: Boxes have no edge below this, m.
_THIN = 1e-3
_PACKAGE = "package://"


def load_robot(urdf: Path, srdf: Path | None = None, packages: Mapping[str, Path] | None = None) -> RobotDescription:
    """Read a robot; collision meshes become boxes, visual shapes are left out.

    Args:
        urdf: The file.
        srdf: Pairs of links that may touch, and postures; without it, neighbours may touch.
        packages: Folders of packages that mesh files are named by.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file that is missing or a mesh that can't be read.
    """
    for path in (urdf, *([] if srdf is None else [srdf])):
        if not path.is_file():
            raise OpenArmError(Code.CONFIG_INVALID, f"there is no file {path}")
    robot = ET.fromstring(urdf.read_text(encoding="utf-8"))
    for link in robot.findall("link"):
        for seen in link.findall("visual"):
            link.remove(seen)
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is not None:
                link.remove(shape)
                link.extend(_boxed(shape, mesh, link.get("name", ""), urdf, packages or {}))
    text = "" if srdf is None else srdf.read_text(encoding="utf-8")
    return RobotDescription.from_urdf(ET.tostring(robot, encoding="unicode"), text)


def boxes_about(triangles: Array) -> list[tuple[Array, Array]]:
    """Lower and upper corners (3,) of boxes that together hold triangles (n, 3, 3)."""
    return _cut(triangles, _CUTS)


def _cut(triangles: Array, cuts: int) -> list[tuple[Array, Array]]:
    points = triangles.reshape(-1, 3)
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, _THIN)
    if cuts == 0:
        return [(low, high)]
    axis = int(np.argmax(size))
    best, pieces = float(np.prod(size)) * (1.0 - _SAVED), None
    for share in (0.25, 0.5, 0.75):
        at = low[axis] + share * size[axis]
        halves = [_side(triangles, axis, at, below) for below in (True, False)]
        if any(len(half) == 0 for half in halves):
            continue
        volume = sum(float(np.prod(np.maximum(np.ptp(half.reshape(-1, 3), axis=0), _THIN))) for half in halves)
        if volume < best:
            best, pieces = volume, halves
    if pieces is None:
        return [(low, high)]
    return [box for piece in pieces for box in _cut(piece, cuts - 1)]


def _side(triangles: Array, axis: int, at: float, below: bool) -> Array:
    """The part of each triangle on one side of a plane, as triangles."""
    out: list[Array] = []
    sign = 1.0 if below else -1.0
    for corners in triangles:
        room = sign * (at - corners[:, axis])
        if np.all(room >= 0.0):
            out.append(corners)
            continue
        if np.all(room <= 0.0):
            continue
        kept: list[Array] = []
        for i in range(3):
            j = (i + 1) % 3
            if room[i] >= 0.0:
                kept.append(corners[i])
            if (room[i] > 0.0) != (room[j] > 0.0) and room[i] != room[j]:
                kept.append(corners[i] + room[i] / (room[i] - room[j]) * (corners[j] - corners[i]))
        out += [np.array([kept[0], kept[k], kept[k + 1]]) for k in range(1, len(kept) - 1)]
    return np.array(out).reshape(-1, 3, 3)


def _boxed(
    shape: ET.Element, mesh: ET.Element, link: str, urdf: Path, packages: Mapping[str, Path]
) -> list[ET.Element]:
    """Collision elements of boxes in place of one of a mesh."""
    name = mesh.get("filename", "")
    path = _found(name, urdf, packages)
    scale = np.array([float(x) for x in mesh.get("scale", "1 1 1").split()])
    try:
        loaded = coal.MeshLoader().load(str(path), scale)
    except (RuntimeError, ValueError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: link {link!r}: can't read mesh {path}: {error}") from error
    vertices = np.array([loaded.vertex(i) for i in range(loaded.num_vertices)], dtype=np.float64)
    corners = [[loaded.tri_indices(i)[k] for k in range(3)] for i in range(loaded.num_tris)]
    T = _origin(shape)
    out: list[ET.Element] = []
    for k, (low, high) in enumerate(boxes_about(vertices[np.array(corners)])):
        box = ET.Element("collision", {"name": f"{link}_{path.stem}_{k}"})
        centre = T[:3, :3] @ (0.5 * (low + high)) + T[:3, 3]
        origin = shape.find("origin")
        rpy = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
        ET.SubElement(box, "origin", {"xyz": _text(centre), "rpy": rpy})
        ET.SubElement(ET.SubElement(box, "geometry"), "box", {"size": _text(np.maximum(high - low, _THIN))})
        out.append(box)
    return out


def _found(name: str, urdf: Path, packages: Mapping[str, Path]) -> Path:
    if name.startswith(_PACKAGE):
        package, _, rest = name.removeprefix(_PACKAGE).partition("/")
        if package not in packages:
            known = ", ".join(packages) or "none"
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{urdf}: mesh {name!r}: package {package!r} has no folder; packages with one: {known}",
            )
        path = packages[package] / rest
    else:
        path = urdf.parent / name.removeprefix("file://")
    if not path.is_file():
        raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: there is no mesh {path}")
    return path


def _origin(shape: ET.Element) -> Array:
    T = np.eye(4)
    origin = shape.find("origin")
    if origin is not None:
        T[:3, 3] = [float(x) for x in origin.get("xyz", "0 0 0").split()]
        roll, pitch, yaw = (float(x) for x in origin.get("rpy", "0 0 0").split())
        T[:3, :3] = se3.matrix_from_rpy(roll, pitch, yaw)
    return T


def _text(values: Array) -> str:
    return " ".join(repr(float(x)) for x in values)
