# SPDX-License-Identifier: Apache-2.0
"""The map as planning sees it: occupied cells that nothing known explains. Base frame, m.

The map knows the table, the objects and what a hand holds as cells of its own, up to a cell's diagonal too thick. What
is known better (bodies of the scene, detections, held boxes, the robot) is taken from there, and its cells are left
out: a cell is explained when its middle lies within such a body and a padding. Cells in the robot itself are errors:
nothing else can be where the robot is.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import coal
import numpy as np
from numpy.typing import NDArray

from openarm_common.octree import distance_kernels as kernels
from openarm_common.octree.distance_field import DistanceField
from openarm_common.octree.lattice import Lattice
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array, Floats
from openarm_motion.collision.solids import Box, Solid, solid_from

#: Distances are cut here: more than the largest sphere of a link with its clearance needs, m.
_REACH = 0.2
#: What the map is called in refusals.
MAP = "the map"


@dataclass(frozen=True, eq=False)
class DistanceMap:
    """Distances (x, y, z), m, between centres of cells, to the nearest occupied one, cut at `reach`.

    Attributes:
        distances: float32, m.
        corner: (3,) lower corner of the first cell, base frame, m.
        resolution: Edge of a cell, m.
        reach: Largest distance; others are cut to it, m.
    """

    distances: Floats
    corner: Array
    resolution: float
    reach: float


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """Occupied cells.

    Attributes:
        indices: (n, 3) of the cells on the lattice.
        lattice: Cells of the map.
        version: Version of the map.
    """

    indices: NDArray[np.int64]
    lattice: Lattice
    version: int

    @classmethod
    def of(cls, field: DistanceField) -> OccupancyMap:
        """The cells of a distance field that are at no distance from an obstacle."""
        return cls(np.argwhere(field.distances == 0.0), field.lattice, field.version)

    @property
    def centres(self) -> Array:
        """(n, 3) middles of the cells, m."""
        return self.lattice.centres(self.indices)

    def without(self, bodies: Iterable[Solid], padding: float) -> OccupancyMap:
        """The map without the cells whose middles lie within `padding` of one of the bodies (base frame), m."""
        centres = self.centres
        left = np.ones(len(centres), np.bool_)
        for body in bodies:
            left &= ~body.inside(centres, padding)
        return self if left.all() else replace(self, indices=self.indices[left])

    def united(self, other: OccupancyMap) -> OccupancyMap:
        """The cells of both, which are of one size."""
        both = (self, other)
        first = np.min([one.lattice.key_min for one in both], axis=0)
        end = np.max([np.add(one.lattice.key_min, one.lattice.shape) for one in both], axis=0)
        indices = np.concatenate([one.indices + (np.array(one.lattice.key_min) - first) for one in both])
        (x, y, z), (nx, ny, nz) = first.tolist(), (end - first).tolist()
        return replace(self, indices=indices, lattice=Lattice(self.lattice.resolution, (x, y, z), (nx, ny, nz)))

    def minus(self, rows: NDArray[np.int64]) -> OccupancyMap:
        """The map without some of its cells."""
        return replace(self, indices=np.delete(self.indices, rows, axis=0))

    def touched(
        self, shape: coal.CollisionGeometry, place: coal.Transform3s, ball: tuple[Array, float], near: float
    ) -> set[int]:
        """Rows of the cells within `near` of a shape at a place; `ball` is the centre (3,) and radius about it, m."""
        edge, centres, found = self.lattice.resolution, self.centres, set[int]()
        cell, request = coal.Box(edge, edge, edge), coal.DistanceRequest()
        for c in np.flatnonzero(np.linalg.norm(centres - ball[0], axis=1) < ball[1] + edge + near):
            there = coal.Transform3s(np.eye(3), centres[c])
            if coal.distance(shape, place, cell, there, request, coal.DistanceResult()) < near:
                found.add(int(c))
        return found

    def at(self, p: Array) -> tuple[float, float, float]:
        """The middle of the cell nearest to a point (3,), m."""
        nearest = self.centres[int(np.argmin(np.linalg.norm(self.centres - p, axis=1)))]
        return (float(nearest[0]), float(nearest[1]), float(nearest[2]))

    @cached_property
    def octree(self) -> coal.OcTree:
        """For exact checks; there must be a cell."""
        return coal.makeOctree(np.asfortranarray(self.centres), self.lattice.resolution)

    @cached_property
    def distances(self) -> DistanceMap:
        """For fast checks."""
        edge, shape = self.lattice.resolution, self.lattice.shape
        occupied = np.zeros(shape, np.uint8)
        occupied[tuple(self.indices.T)] = 1
        cap, cells = np.float32((_REACH / edge) ** 2), int(np.ceil(_REACH / edge))
        plane, ring = np.empty(shape[1:], np.float32), np.empty((cells, *shape[1:]), np.float32)
        squares = np.empty(shape, np.float32)
        kernels.along_z(occupied, 1, cap, squares)
        kernels.along_y(squares, cap, cells, plane)
        kernels.along_x(squares, cap, cells, np.float32(edge), plane[0], ring)
        return DistanceMap(squares, self.lattice.lower, edge, _REACH)


@dataclass(frozen=True, eq=False)
class Environment:
    """What is around the robot, whatever a request says.

    Attributes:
        solids: Bodies of the planning scene.
        map: Map of the cameras.
        arm_clearance: The arms keep at least this distance from each other, m.
        allowed: Pairs of links and bodies that may touch, by name.
    """

    solids: tuple[Solid, ...] = ()
    map: OccupancyMap | None = None
    arm_clearance: float = 0.0
    allowed: frozenset[frozenset[str]] = frozenset()


#: An empty scene, and no map.
NOTHING = Environment()


def robot_bodies(description: RobotDescription, state: Mapping[str, float]) -> list[Solid]:
    """The robot's collision shapes in a state, base frame."""
    poses = description.link_poses(state)
    return [
        solid_from(link.name, poses[link.name] @ shape.T_link_primitive, shape)
        for link in description.links.values()
        for shape in link.collision
    ]


def carried(held: Sequence[Box], T_base_tool: Array) -> list[Box]:
    """Held boxes (tool frame) in the base frame."""
    return [replace(box, T=T_base_tool @ box.T) for box in held]
