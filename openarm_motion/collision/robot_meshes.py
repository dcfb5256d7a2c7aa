# SPDX-License-Identifier: Apache-2.0
"""Other robots: a URDF whose collision shapes are meshes, read with the convex hulls of these. m, link axes."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import coal
import numpy as np

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import is_file
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.urdf import Link, Primitive, origin
from openarm_common.robot.xml_text import floats, parse_root
from openarm_motion.collision.hulls import convex_parts

_PACKAGE = "package://"


def load_robot(urdf: Path, srdf: Path | None = None, packages: Mapping[str, Path] | None = None) -> RobotDescription:
    """Read a robot; collision meshes become few convex hulls each, visual shapes are left out.

    No point of a mesh is outside its hulls; how far these reach beyond it is up to its hollows. The text of the
    description keeps the meshes.

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
    hulls: dict[str, list[Primitive]] = {}
    for link in robot.findall("link"):
        name = link.get("name", "")
        for seen in link.findall("visual"):
            link.remove(seen)
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is not None:
                hulls.setdefault(name, []).extend(_hulls(shape, mesh, name, urdf, packages or {}))
    description = RobotDescription.from_urdf(
        ET.tostring(robot, encoding="unicode"), "" if srdf is None else read_text(srdf)
    )
    links = {
        name: Link(name, (*link.collision, *hulls.get(name, ())), link.visual)
        for name, link in description.links.items()
    }
    return replace(description, links=MappingProxyType(links))


def _hulls(shape: ET.Element, mesh: ET.Element, link: str, urdf: Path, packages: Mapping[str, Path]) -> list[Primitive]:
    """Shapes in place of one collision element with a mesh, whose file name becomes absolute."""
    path = _found(mesh.get("filename", ""), urdf, packages)
    mesh.set("filename", str(path.resolve()))
    scale = np.array(floats(mesh.get("scale", "1 1 1"), 3, mesh))
    try:
        loaded = coal.MeshLoader().load(str(path), scale)
    except (RuntimeError, ValueError) as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{urdf}: link {link!r}: can't read mesh {path}: {said(error)}"
        ) from error
    vertices = np.array([loaded.vertex(i) for i in range(loaded.num_vertices)], dtype=np.float64)
    triangles = np.array([[loaded.tri_indices(i)[k] for k in range(3)] for i in range(loaded.num_tris)], np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        text = "has points that are not finite" if len(triangles) else "has no triangle"
        raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: link {link!r}: mesh {path} {text}")
    out: list[Primitive] = []
    for k, corners in enumerate(convex_parts(vertices, triangles)):
        low, high = corners.min(axis=0), corners.max(axis=0)
        T = origin(shape)
        T[:3, 3] += T[:3, :3] @ (0.5 * (low + high))
        x, y, z = (float(edge) for edge in high - low)
        name = shape.get("name") or f"{link}_{path.stem}"
        out.append(Primitive(f"{name}_{k}", "box", (x, y, z), T, corners=corners - 0.5 * (low + high)))
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
