# SPDX-License-Identifier: Apache-2.0
"""Mesh files of a robot folder: hulls that MuJoCo collides with, and what is seen, with fewer triangles. m."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.meshes import read_mesh
from openarm_common.types import Array
from openarm_sim_bridge.drafting.collisions import coarse_hull, hull_mesh
from openarm_sim_bridge.drafting.edits import matching

Triangles = NDArray[np.int64]
#: A visual mesh keeps this many triangles, or all that it has.
_LEAST = 60
#: Aggressiveness of the simplification, from 0 on, and the distance at which corners are one, m: lower ones keep shapes
#: longer; the next where a mesh, torn or of many shells, keeps too many triangles.
_ATTEMPTS = ((2, 1e-6), (5, 1e-6), (5, 5e-4), (8, 1e-3), (8, 2e-3))
_ENOUGH = 1.2
#: Extents of a mesh and of its simplification differ by less, m.
_ALIKE = 0.002
#: Most triangles of a mesh that MuJoCo reads.
MOST = 200_000
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


@dataclass(frozen=True, eq=False)
class PlacedMesh:
    """A mesh file as a link has it: `T` (4, 4) and `signs` (3,), which mirror it first."""

    file: str
    T: Array
    signs: Array


class MeshFiles:
    """Meshes of a compiled model, each in the frame and unit of its file, so that parts that share a file go on to.

    Args:
        model: Compiled from an MJCF.
        shared: Folder next to the robot's, of one whose files are taken where name and extents are the same.
    """

    def __init__(self, model: mujoco.MjModel, shared: Path | None = None) -> None:
        self._model, self._shared = model, shared
        self._names: set[str] = set()
        self._files: dict[str, tuple[Array, Triangles]] = {}
        self._sources: dict[tuple[str, tuple[float, ...]], str] = {}
        self._uses: dict[str, int] = {}

    def placed(self, geom: Any, *, seen: bool, coarse: bool = False) -> PlacedMesh:
        """Take the mesh of a geom.

        Args:
            geom: Geom of the model.
            seen: Its triangles, or else its convex hull, which MuJoCo collides with.
            coarse: A hull of few triangles around one that is made to be seen.
        """
        model, k = self._model, int(geom.dataid[0])
        scale = np.array(model.mesh_scale[k])
        T_file_mesh = _pose(model.mesh_pos[k], model.mesh_quat[k])
        T = _pose(geom.pos, geom.quat) @ np.linalg.inv(T_file_mesh)
        path = _path(model, k) or model.mesh(k).name
        file = self._sources.get((path, (*np.abs(scale), seen)))
        if file is None:
            file = self._name(Path(path).stem, seen)
            first, count = int(model.mesh_vertadr[k]), int(model.mesh_vertnum[k])
            vertices = se3.apply(T_file_mesh, np.array(model.mesh_vert[first : first + count], np.float64))
            vertices *= np.sign(scale)
            first, count = int(model.mesh_faceadr[k]), int(model.mesh_facenum[k])
            triangles = np.array(model.mesh_face[first : first + count], np.int64)
            if np.prod(scale) < 0.0:
                triangles = triangles[:, ::-1]  # MuJoCo has turned them
            hull = coarse_hull if coarse else hull_mesh
            found = (vertices, triangles) if seen else hull(np.unique(vertices, axis=0))
            if self._shared is not None and _alike(self._shared / file, found[0]):
                file = f"../{self._shared.name}/{file}"
            else:
                self._files[file] = found
            self._sources[path, (*np.abs(scale), seen)] = file
        self._uses[file] = self._uses.get(file, 0) + 1
        return PlacedMesh(file, T, np.sign(scale))

    def write(self, folder: Path, limit: int, detail: Mapping[str, float]) -> int:
        """Write the files.

        Args:
            folder: Folder of the robot.
            limit: Most triangles that are seen, each as often as it is.
            detail: Weight by the stem of a visual mesh, see `Edits`.

        Returns:
            Triangles that are seen.

        Raises:
            OpenArmError: ENVIRONMENT, when meshes must be simplified and fast-simplification is not installed.
        """
        seen = {file: found for file, found in self._files.items() if file.startswith("meshes/visual/")}
        weights = {file: matching(detail, Path(file).stem, 1.0) for file in seen}
        budgets = _budgets({f: (len(t), self._uses[f], weights[f]) for f, (_, t) in seen.items()}, limit)
        total = 0
        for file, (vertices, triangles) in self._files.items():
            path = folder / file
            path.parent.mkdir(parents=True, exist_ok=True)
            if file in seen:
                vertices, triangles = simplified(vertices, triangles, budgets[file])
                total += self._uses[file] * len(triangles)
            write_stl(path, vertices, triangles)
        return total

    def _name(self, stem: str, seen: bool) -> str:
        """A file of a name of its own: MuJoCo reads a URDF's meshes by the last part of their paths."""
        stem = stem if seen else f"{stem}_hull"
        number = next(n for n in range(len(self._names) + 1) if (f"{stem}_{n}" if n else stem) not in self._names)
        self._names.add(f"{stem}_{number}" if number else stem)
        return f"meshes/{'visual' if seen else 'collision'}/{f'{stem}_{number}' if number else stem}.stl"


def _alike(file: Path, vertices: Array) -> bool:
    """Whether there is such a mesh file, of the extents of these vertices (n, 3)."""
    if not file.is_file():
        return False
    there, _ = read_mesh(file, np.ones(3))
    extents = np.array([vertices.min(axis=0), vertices.max(axis=0)])
    return bool(np.abs(extents - [there.min(axis=0), there.max(axis=0)]).max() < _ALIKE)


def is_binary_stl(path: Path) -> bool:
    """Whether a file is STL in binary form, as long as its number of triangles says, which MuJoCo reads."""
    with path.open("rb") as file:
        head = file.read(84)
    count = int.from_bytes(head[80:], "little")
    return path.suffix.lower() == ".stl" and 0 < count <= MOST and path.stat().st_size == 84 + count * _FACET.itemsize


def write_stl(path: Path, vertices: Array, triangles: Triangles) -> None:
    """Write triangles (m, 3) of vertices (n, 3) as binary STL."""
    facets = np.zeros(len(triangles), _FACET)
    facets["corners"] = vertices[triangles]
    a, b, c = (vertices[triangles[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    facets["normal"] = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    path.write_bytes(bytes(80) + len(facets).to_bytes(4, "little") + facets.tobytes())


def simplified(vertices: Array, triangles: Triangles, budget: int) -> tuple[Array, Triangles]:
    """Return a mesh with about as many triangles as given, by quadric error metrics.

    Garland and Heckbert, "Surface simplification using quadric error metrics", 1997, as fast-simplification has it.

    Raises:
        OpenArmError: ENVIRONMENT, when fast-simplification is not installed.
    """
    if len(triangles) <= budget:
        return vertices, triangles
    try:
        import fast_simplification  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise OpenArmError(
            Code.ENVIRONMENT,
            "visual meshes are simplified with fast-simplification, which is not installed: extra `draft`",
        ) from error
    found: tuple[Any, Any] = vertices, triangles
    for strength, cell in _ATTEMPTS:
        # triangles that share a corner must say so
        points, same = np.unique((vertices / cell).round() * cell, axis=0, return_inverse=True)
        faces = same.reshape(-1)[triangles].astype(np.int32)
        a, b, c = faces.T
        faces = faces[(a != b) & (b != c) & (c != a)]
        if len(faces) <= budget:  # corners that are one now have left no more
            found = points, faces
            break
        found = fast_simplification.simplify(points.astype(np.float32), faces, target_count=budget, agg=strength)
        if len(found[1]) <= _ENOUGH * budget:
            break
    return np.asarray(found[0], np.float64), np.asarray(found[1], np.int64)


def _budgets(meshes: Mapping[str, tuple[int, int, float]], limit: int) -> dict[str, int]:
    """Triangles of each mesh, given those that it has, its uses and its weight: the same share, times the weight."""

    def shares(share: float) -> dict[str, int]:
        return {
            name: min(count, max(_LEAST, int(count * min(1.0, share * weight))))
            for name, (count, _, weight) in meshes.items()
        }

    low, high = 0.0, 1.0 / min((weight for _, _, weight in meshes.values()), default=1.0)
    if sum(count * uses for count, uses, _ in meshes.values()) <= limit:
        return shares(high)
    for _ in range(40):
        middle = 0.5 * (low + high)
        total = sum(n * meshes[name][1] for name, n in shares(middle).items())
        low, high = (middle, high) if total <= limit else (low, middle)
    return shares(low)


def _path(model: mujoco.MjModel, mesh: int) -> str:
    """Return the file that a mesh was read from, "" for one that is in the MJCF."""
    start = int(model.mesh_pathadr[mesh])
    return "" if start < 0 else model.paths[start : model.paths.index(b"\0", start)].decode()


def _pose(position: Array, quaternion: Array) -> Array:
    """Pose (4, 4) of a position and a quaternion w, x, y, z."""
    w, x, y, z = quaternion
    return se3.make(se3.matrix_from_quat_xyzw([x, y, z, w]), position)
