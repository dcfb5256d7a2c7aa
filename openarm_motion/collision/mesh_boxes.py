# SPDX-License-Identifier: Apache-2.0
"""Other robots: a URDF whose collision shapes are meshes, read with boxes that hold them. m, link axes.

Both collision layers work on primitives. A mesh is cut along its longest side, again and again while that saves room,
and each piece gets the box about it; no point of the mesh is left outside.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping, Sequence
from pathlib import Path

import coal
import numpy as np

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import is_file
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.urdf import origin
from openarm_common.robot.xml_text import floats, parse_root
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
        if not is_file(path):
            raise OpenArmError(Code.CONFIG_INVALID, f"there is no file {path}")
    robot = parse_root(read_text(urdf), str(urdf))
    for link in robot.findall("link"):
        for seen in link.findall("visual"):
            link.remove(seen)
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is not None:
                link.remove(shape)
                link.extend(_boxed(shape, mesh, link.get("name", ""), urdf, packages or {}))
    text = "" if srdf is None else read_text(srdf)
    return RobotDescription.from_urdf(ET.tostring(robot, encoding="unicode"), text)


def boxes_about(polygons: Sequence[Array], cuts: int = _CUTS) -> list[tuple[Array, Array]]:
    """Lower and upper corners (3,) of boxes that together hold convex polygons (n, 3).

    Args:
        polygons: Triangles of a mesh, or what cuts left of them.
        cuts: How often a piece may be cut again.
    """
    points = np.concatenate(polygons)
    low, high = points.min(axis=0), points.max(axis=0)
    size = np.maximum(high - low, _THIN)
    axis = int(np.argmax(size))
    planes = [low[axis] + share * size[axis] for share in (0.25, 0.5, 0.75)] if cuts else []
    halves = [[_clipped(polygons, axis, at, sign) for sign in (1.0, -1.0)] for at in planes]
    pieces = min((half for half in halves if all(half)), key=_volume, default=[polygons])
    if _volume(pieces) >= (1.0 - _SAVED) * _volume([polygons]):
        return [(low, high)]
    return [box for piece in pieces for box in boxes_about(piece, cuts - 1)]


def _volume(pieces: Sequence[Sequence[Array]]) -> float:
    """Of the boxes about pieces of a mesh in all, m³."""
    return sum(float(np.prod(np.maximum(np.ptp(np.concatenate(piece), axis=0), _THIN))) for piece in pieces)


def _clipped(polygons: Sequence[Array], axis: int, at: float, sign: float) -> list[Array]:
    """The part of each polygon on one side of a plane: below `at` for `sign` 1, above for -1."""
    out: list[Array] = []
    for polygon in polygons:
        room = sign * (at - polygon[:, axis])
        if np.all(room <= 0.0) and np.any(room < 0.0):
            continue
        ends, left = np.roll(polygon, -1, axis=0), np.roll(room, -1)
        crossing = room * left < 0.0
        share = (room[crossing] / (room[crossing] - left[crossing]))[:, None]
        cuts = polygon[crossing] + share * (ends[crossing] - polygon[crossing])
        # each cut comes behind the corner that its edge begins at
        order = np.argsort(np.concatenate([np.flatnonzero(room >= 0.0), np.flatnonzero(crossing) + 0.5]))
        out.append(np.concatenate([polygon[room >= 0.0], cuts])[order])
    return out


def _boxed(
    shape: ET.Element, mesh: ET.Element, link: str, urdf: Path, packages: Mapping[str, Path]
) -> list[ET.Element]:
    """Collision elements of boxes in place of one of a mesh."""
    name = mesh.get("filename", "")
    path = _found(name, urdf, packages)
    scale = np.array(floats(mesh.get("scale", "1 1 1"), 3, mesh))
    try:
        loaded = coal.MeshLoader().load(str(path), scale)
    except (RuntimeError, ValueError) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{urdf}: link {link!r}: can't read mesh {path}: {said(error)}"
        ) from error
    vertices = np.array([loaded.vertex(i) for i in range(loaded.num_vertices)], dtype=np.float64)
    corners = [[loaded.tri_indices(i)[k] for k in range(3)] for i in range(loaded.num_tris)]
    if not corners or not np.isfinite(vertices).all():
        text = "has points that are not finite" if corners else "has no triangle"
        raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: link {link!r}: mesh {path} {text}")
    T, placed = origin(shape), shape.find("origin")
    rpy = "0 0 0" if placed is None else placed.get("rpy", "0 0 0")
    out: list[ET.Element] = []
    for k, (low, high) in enumerate(boxes_about([*vertices[np.array(corners)]])):
        box = ET.Element("collision", {"name": f"{link}_{path.stem}_{k}"})
        centre = T[:3, :3] @ (0.5 * (low + high)) + T[:3, 3]
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
    if not is_file(path):
        raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: there is no mesh {path}")
    return path


def _text(values: Array) -> str:
    return " ".join(repr(float(x)) for x in values)
