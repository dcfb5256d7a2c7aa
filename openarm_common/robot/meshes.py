# SPDX-License-Identifier: Apache-2.0
"""Meshes of a URDF: where their files are, and the convex hulls that stand for those of its collision shapes. m."""

from __future__ import annotations

import importlib.util
import os
import re
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from openarm_common.config import read_text
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.resources import is_file
from openarm_common.robot.urdf import Primitive, origin
from openarm_common.robot.xml_text import floats
from openarm_common.types import Array

_PACKAGE, _FILE = "package://", "file://"
#: First words of the file that Git LFS has in place of one that it has not brought.
_LFS = b"version https://git-lfs"
#: How far corners of a convex mesh may be outside the plane of a triangle, and how low a triangle may be that says
#: nothing about its plane: shares of the mesh's diagonal.
_FLAT, _SLIVER = 1e-4, 1e-3
#: Elements of Collada that are lists of indices or counts.
_INDICES = ("p", "v", "vcount", "h")
#: Distances of corners to planes that are in memory at once.
_BLOCK = 1_000_000


def mesh_file(name: str, urdf: Path, packages: Mapping[str, Path] | None = None) -> Path:
    """Find the file of a mesh.

    Args:
        name: Name in the URDF: a path, absolute or from the folder of the URDF, `file://PATH`, or
            `package://NAME/PATH`; see `package_folders`. A path that is not there but has `/share/NAME/`, as a xacro
            that was expanded on another machine, is that of a package.
        urdf: File of the description.
        packages: Folders of packages by name.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what was tried.
    """
    if not name.startswith(_PACKAGE):
        path = urdf.parent / name.removeprefix(_FILE)
        if is_file(path):
            return _whole(path)
        _, _, rest = name.partition("/share/")
        if "/" not in rest:
            way = "name it from the folder of this file, or by package://NAME/PATH"
            raise OpenArmError(Code.CONFIG_INVALID, f"{urdf}: there is no mesh {path}; {way}")
    else:
        rest = name.removeprefix(_PACKAGE)
    package, _, rest = rest.partition("/")
    folders = list(package_folders(package, urdf, packages or {}))
    tried = [folder / rest.lstrip("/") for folder in folders]
    for path in tried:
        if is_file(path):
            return _whole(path)
    places = ", ".join(map(str, dict.fromkeys(tried)))
    here = next((f"{folder} lacks it: get the file there, or " for folder in folders if folder.is_dir()), "")
    text = f"{urdf}: there is no mesh {name!r}; tried {places}; {here}{package_advice(package)}"
    raise OpenArmError(Code.CONFIG_INVALID, text)


def _whole(path: Path) -> Path:
    """Return a file that is there, and not only what Git LFS has in its place."""
    with path.open("rb") as file:
        if file.read(len(_LFS)) == _LFS:
            text = f"there is no mesh {path}, but what Git LFS has in its place; `git lfs pull` in its folder brings it"
            raise OpenArmError(Code.CONFIG_INVALID, text)
    return path


def package_advice(package: str) -> str:
    """Return what to do where a package is not found."""
    return f"name its folder by --package {package}=FOLDER of `openarm model new`, or its parent in ROS_PACKAGE_PATH"


def take_meshes(
    robot: ET.Element, urdf: Path, packages: Mapping[str, Path] | None = None
) -> dict[str, tuple[Primitive, ...]]:
    """Read the collision meshes of a robot; names of files become absolute in the document.

    A mesh that is convex is taken as it is, another becomes few convex hulls. No point of a mesh is outside its hulls;
    how far these reach beyond it is up to its hollows. Visual meshes are not read here.

    Args:
        robot: The <robot> document, changed.
        urdf: The file it is from.
        packages: See `mesh_file`.

    Returns:
        By link.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file that is missing or a mesh that can't be read.
    """
    for mesh in robot.findall("link/visual/geometry/mesh"):
        try:
            mesh.set("filename", _absolute(mesh_file(mesh.get("filename", ""), urdf, packages)))
        except OpenArmError:
            continue  # the simulation and the page need it, and say so; `openarm model check`, too
    hulls: dict[str, tuple[Primitive, ...]] = {}
    for link in robot.findall("link"):
        name, found = link.get("name", ""), list[Primitive]()
        for shape in link.findall("collision"):
            mesh = shape.find("geometry/mesh")
            if mesh is not None:
                path = mesh_file(mesh.get("filename", ""), urdf, packages)
                mesh.set("filename", _absolute(path))
                scale = np.array(floats(mesh.get("scale", "1 1 1"), 3, mesh))
                try:
                    found += _hulls(path, scale, shape.get("name") or f"{name}_{path.stem}", origin(shape))
                except OpenArmError as error:
                    raise OpenArmError(error.code, f"{urdf}: link {name!r}: {error.message}") from error
        if found:
            hulls[name] = tuple(found)
    return hulls


def _hulls(path: Path, scale: Array, name: str, T: Array) -> list[Primitive]:
    """Shapes in place of a mesh with a pose (4, 4) on its link."""
    vertices, triangles = read_mesh(path, scale)
    if is_convex(vertices, triangles):
        parts = [np.unique(vertices[np.unique(triangles)], axis=0)]
    else:
        from openarm_common.robot.convex import convex_parts  # takes longer to import than convex meshes to read

        parts = convex_parts(vertices, triangles)
    out: list[Primitive] = []
    for k, corners in enumerate(parts):
        low, high = corners.min(axis=0), corners.max(axis=0)
        place = T.copy()
        place[:3, 3] += T[:3, :3] @ (0.5 * (low + high))
        x, y, z = (float(edge) for edge in high - low)
        part = name if len(parts) == 1 else f"{name}_{k}"
        out.append(Primitive(part, "box", (x, y, z), place, corners=corners - 0.5 * (low + high)))
    return out


def read_mesh(path: Path, scale: Array) -> tuple[Array, NDArray[np.int64]]:
    """Read a mesh; returns vertices (n, 3), m, and triangles (m, 3).

    Args:
        path: STL, OBJ, DAE or what else coal reads.
        scale: (3,) factors of x, y, z; negative ones mirror.

    Raises:
        OpenArmError: CONFIG_INVALID, for what is no mesh.
    """
    import coal

    if not scale.all():
        raise OpenArmError(Code.CONFIG_INVALID, f"mesh {path} has scale {scale.tolist()}, expected no 0")
    if path.suffix.lower() == ".dae":
        _check_collada(path)
    try:
        loaded = coal.MeshLoader().load(str(path), scale)
    except (RuntimeError, ValueError) as error:
        why = said(error).rpartition("message: ")[2]
        raise OpenArmError(Code.CONFIG_INVALID, f"can't read mesh {path}: {why}") from error
    vertices = np.array(loaded.vertices(), dtype=np.float64).reshape(-1, 3)
    triangles = np.array([[t[0], t[1], t[2]] for t in map(loaded.tri_indices, range(loaded.num_tris))], np.int64)
    if not len(triangles) or not np.isfinite(vertices).all():
        text = "has points that are not finite" if len(triangles) else "has no triangle"
        raise OpenArmError(Code.CONFIG_INVALID, f"mesh {path} {text}")
    return vertices, triangles


def _check_collada(path: Path) -> None:
    """Refuse what the reader of Collada would never end with: no XML, and indices that are no numbers."""
    try:
        root = ET.parse(path).getroot()
    except (ET.ParseError, LookupError, ValueError) as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"can't read mesh {path}: {said(error)}") from error
    for element in root.iter():
        tag = element.tag.rpartition("}")[2]
        if tag in _INDICES and not re.fullmatch(r"[\s\d-]*", element.text or ""):
            raise OpenArmError(Code.CONFIG_INVALID, f"can't read mesh {path}: <{tag}> has indices that are no numbers")


def is_convex(vertices: Array, triangles: NDArray[np.int64]) -> bool:
    """Whether no vertex (n, 3) is beyond the plane of a triangle (m, 3), be it turned outwards or inwards.

    What is flat is not: it has no volume.
    """
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    normal = np.cross(b - a, c - a)
    twice = np.linalg.norm(normal, axis=1)
    longest = np.sqrt(np.max([((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))], axis=0))
    telling = twice > _SLIVER * size * longest
    if not telling.any():
        return False
    unit = normal[telling] / twice[telling, None]
    level = np.einsum("ij,ij->i", unit, a[telling])
    step = max(1, _BLOCK // len(vertices))
    for first in range(0, len(unit), step):
        off = unit[first : first + step] @ vertices.T - level[first : first + step, None]
        above, below = off.max(axis=1), -off.min(axis=1)
        if (np.minimum(above, below) > _FLAT * size).any() or (np.maximum(above, below) <= _FLAT * size).any():
            return False
    return True


def _absolute(path: Path) -> str:
    return f"{_FILE}{path.resolve()}"


def package_folders(package: str, source: Path, packages: Mapping[str, Path]) -> Iterator[Path]:
    """Yield folders that may be a package, the likeliest first.

    They are: that of `packages`; one above the source whose `package.xml` or own name says so, or `package` in one of
    them; `package` in a folder of ROS_PACKAGE_PATH, or such a folder itself; `package` in `share` of the Python
    environment or of a prefix in AMENT_PREFIX_PATH; the same in the tree of the Python package of that name.

    Args:
        package: Name of the package.
        source: File of the description.
        packages: Folders of packages by name.
    """
    if package in packages:
        yield packages[package]
    for parent in source.absolute().parents:
        if package in (parent.name, _package_name(parent)):
            yield parent
        if os.path.isdir(parent / package):
            yield parent / package
    for folder in map(Path, filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))):
        yield folder if package in (folder.name, _package_name(folder)) else folder / package
    prefixes = [sys.prefix, *filter(None, os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep))]
    yield from (Path(prefix) / "share" / package for prefix in prefixes)
    yield from _installed(package)


def _package_name(folder: Path) -> str:
    """Return the name that the `package.xml` of a folder says; "" without one."""
    if not is_file(folder / "package.xml"):
        return ""
    try:
        return (ET.fromstring(read_text(folder / "package.xml")).findtext("name") or "").strip()
    except (ET.ParseError, OpenArmError):
        return ""  # it says no name


def _installed(package: str) -> Iterator[Path]:
    """Yield folders in the tree of the Python package of this name."""
    spec = importlib.util.find_spec(package) if package.isidentifier() else None
    for place in (spec.submodule_search_locations or ()) if spec is not None else ():
        yield Path(place)
        yield from (parent / "share" / package for parent in Path(place).parents)
