# SPDX-License-Identifier: Apache-2.0
"""Bodies that plans keep clear of: boxes, cylinders, spheres, and convex hulls of meshes. m."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property

import coal
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import QhullError

from openarm_common.collision.hulls import Hull
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive
from openarm_common.types import Array


@dataclass(frozen=True, eq=False)
class Solid(ABC):
    """A body: `id` for messages, `T` (4, 4) its pose."""

    id: str
    T: Array

    @property
    @abstractmethod
    def geometry(self) -> coal.ShapeBase:
        """Shape for exact checks, in the frame of `T`."""

    @property
    @abstractmethod
    def extents(self) -> Array:
        """(3,) full edges of the box about it, along its own axes, m."""

    @property
    def centre(self) -> Array:
        """(3,) middle of that box in the frame of `T`, m."""
        return np.zeros(3)

    def inside(self, points: Array, padding: float = 0.0) -> NDArray[np.bool_]:
        """Whether points (n, 3), given like `T`, lie within the box about it and a padding (n,)."""
        local = (points - self.T[:3, 3]) @ self.T[:3, :3] - self.centre
        return np.asarray((np.abs(local) <= 0.5 * self.extents + padding).all(axis=1))

    def _refuse(self, what: str, expected: str) -> OpenArmError:
        kind = type(self).__name__.lower()
        return OpenArmError(Code.INVALID_ARGUMENT, f"{kind} {self.id!r} has {what}, expected {expected}")


@dataclass(frozen=True, eq=False)
class Box(Solid):
    """An oriented box: `size` (3,) full edges, m."""

    size: Array

    def __post_init__(self) -> None:
        """Refuse a box that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the box and its size.
        """
        if self.size.shape != (3,) or not np.all(np.isfinite(self.size)) or not np.all(self.size > 0.0):
            raise self._refuse(f"size {self.size.tolist()}", "three edges > 0 m")

    @property
    def geometry(self) -> coal.ShapeBase:
        """See `Solid`."""
        return coal.Box(*self.size.tolist())

    @property
    def extents(self) -> Array:
        """See `Solid`."""
        return self.size


@dataclass(frozen=True, eq=False)
class Cylinder(Solid):
    """A cylinder about its own z: `radius` and `length`, m."""

    radius: float
    length: float

    def __post_init__(self) -> None:
        """Refuse a cylinder that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming it and its numbers.
        """
        if not (np.isfinite([self.radius, self.length]).all() and min(self.radius, self.length) > 0.0):
            raise self._refuse(f"diameter {2 * self.radius:g} m and height {self.length:g} m", "both > 0")

    @property
    def geometry(self) -> coal.ShapeBase:
        """See `Solid`."""
        return coal.Cylinder(self.radius, self.length)

    @property
    def extents(self) -> Array:
        """See `Solid`."""
        return np.array([2.0 * self.radius, 2.0 * self.radius, self.length])


@dataclass(frozen=True, eq=False)
class Sphere(Solid):
    """A ball of `radius`, m."""

    radius: float

    def __post_init__(self) -> None:
        """Refuse a ball that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming it and its radius.
        """
        if not (np.isfinite(self.radius) and self.radius > 0.0):
            raise self._refuse(f"diameter {2 * self.radius:g} m", "> 0")

    @property
    def geometry(self) -> coal.ShapeBase:
        """See `Solid`."""
        return coal.Sphere(self.radius)

    @property
    def extents(self) -> Array:
        """See `Solid`."""
        return np.full(3, 2.0 * self.radius)


@dataclass(frozen=True, eq=False)
class Mesh(Solid):
    """The convex hull of `vertices` (n, 3), m, in the frame of `T`."""

    vertices: Array

    def __post_init__(self) -> None:
        """Refuse vertices that span no volume.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming it and what is wrong.
        """
        if self.vertices.ndim != 2 or self.vertices.shape[1] != 3 or not np.all(np.isfinite(self.vertices)):
            raise self._refuse(f"vertices of shape {self.vertices.shape}", "finite numbers (n, 3)")
        if len(self.vertices) < 4:
            raise self._refuse(f"{len(self.vertices)} vertices", "at least 4")
        try:
            self.hull  # noqa: B018
        except QhullError as error:
            raise self._refuse("vertices in one plane", "some that span a volume") from error

    @cached_property
    def hull(self) -> Hull:
        """Corners, edges and faces."""
        return Hull.of(self.vertices)

    @property
    def hull_mesh(self) -> tuple[Array, NDArray[np.int64]]:
        """Vertices (k, 3) of the hull, and its triangles (t, 3) turned outwards."""
        return self.hull.corners + self.hull.centre, self.hull.triangles

    @property
    def geometry(self) -> coal.ShapeBase:
        """See `Solid`."""
        points, triangles = self.hull_mesh
        corners = coal.StdVec_Vec3s()
        corners.extend([np.asarray(point) for point in points])
        faces = coal.StdVec_Triangle()
        faces.extend([coal.Triangle(*(int(k) for k in triangle)) for triangle in triangles])
        return coal.Convex(corners, faces)

    @property
    def extents(self) -> Array:
        """See `Solid`."""
        return np.ptp(self.vertices, axis=0)

    @property
    def centre(self) -> Array:
        """See `Solid`."""
        return 0.5 * (self.vertices.min(axis=0) + self.vertices.max(axis=0))


def box_from(id: str, p: ArrayLike, size: ArrayLike, R: Array | None = None) -> Box:
    """Box of its centre (3,), full edges (3,) and rotation (3, 3)."""
    T = np.eye(4)
    T[:3, 3] = p
    if R is not None:
        T[:3, :3] = R
    return Box(id, T, np.asarray(size, dtype=np.float64))


def solid_from(id: str, T: Array, shape: Primitive) -> Solid:
    """Body of a shape of the robot description; `T` (4, 4) is its pose."""
    if shape.corners is not None:
        return Mesh(id, T, shape.corners)
    if shape.kind == "box":
        return Box(id, T, np.array(shape.size))
    if shape.kind == "cylinder":
        return Cylinder(id, T, shape.size[0], shape.size[1])
    return Sphere(id, T, shape.size[0])
