# SPDX-License-Identifier: Apache-2.0
"""The fast collision layer: what an exact scene checks, packed for numba, and the map as distances.

It never calls a state free that the exact layer calls a collision: pairs of shapes count as apart only where an axis
separates their projections by the distance that the exact layer asks for; the map is met by spheres that cover the
shapes. A scene is a snapshot: boxes that are moved later, and other joints, are not followed. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openarm_common import se3
from openarm_common.collision.hulls import Hull, joined_corners
from openarm_common.collision.self_collision import shape_radius
from openarm_common.collision.shape_kernels import BOX, CYLINDER, HULL, SPHERE
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision import clearance_kernels as kernels
from openarm_motion.collision.clearance_kernels import Model, workspace
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.collision.line_kernels import line_free
from openarm_motion.collision.occupancy import DistanceMap
from openarm_motion.collision.solids import Box, Cylinder, Mesh, Solid, Sphere

#: Added to distances, so that rounding does not decide, m.
_ROUNDING = 1e-6
#: Edge of the cells that shapes are cut into before each is put into a sphere, m.
_CELL = 0.045
#: Of one cell, with nothing near to it.
_NO_CORNERS = np.empty((0, 3))
_NO_MAP = DistanceMap(np.full((1, 1, 1), np.inf, np.float32), np.zeros(3), 1.0, np.inf)


class FastScene:
    """One arm, or two as one, in one set of surroundings. Not for two threads at once; `model` may be shared.

    Args:
        scenes: Exact scenes of the arms, one each, of the same robot; configurations are in their order.
        field: Distance field of the other obstacles.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the reach of the map is too short to say anything.
    """

    def __init__(self, scenes: Sequence[CollisionScene], field: DistanceMap | None = None) -> None:
        self.levers: Array = np.concatenate([scene.levers for scene in scenes])
        packed = _Packer(scenes, field)
        self.model: Model = packed.model()
        self._work = workspace(self.model)

    def free(self, q: ArrayLike) -> bool:
        """Whether a state (n,) is proven free."""
        return not kernels.near(np.ascontiguousarray(q, dtype=np.float64), self.model, self._work)

    def free_many(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Whether each of the states (m, n) is proven free."""
        values = np.ascontiguousarray(states, dtype=np.float64)
        out = np.empty(values.shape[0], np.bool_)
        kernels.states_free(values, self.model, out)
        return out

    def edge_free(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.02) -> bool:
        """Whether the straight joint line is free, at the states where the exact layer would check."""
        return bool(line_free(a, b, step, travel, self.levers, self.model, self._work))


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Shapes of one body: the ball about them, in that body."""

    body: int
    centre: Array
    radius: float


class _Swings:
    """How far points move when joints turn, at most.

    Args:
        parents: (n,) body that each joint hangs on.
        offsets: (n,) from the origin of that body to the joint, m.
        prismatic: (n,) which joints slide.
        ends: (n,) furthest that each joint goes from zero, m where it slides.
    """

    def __init__(self, parents: Sequence[int], offsets: Array, prismatic: NDArray[np.bool_], ends: Array) -> None:
        self._parents, self._prismatic = parents, prismatic
        self._offsets: Array = offsets + np.where(prismatic, ends, 0.0)

    def of(self, cluster: _Cluster) -> Array:
        """(n,) for the points of a cluster as seen from the base, m/rad; 1 m/m for a prismatic joint."""
        out = np.zeros(len(self._parents))
        reach = float(np.linalg.norm(cluster.centre)) + cluster.radius
        body = cluster.body
        while body > 0:
            i = body - 1
            out[i] = 1.0 if self._prismatic[i] else reach
            reach += float(self._offsets[i])
            body = self._parents[i]
        return out


class _Packer:
    def __init__(self, scenes: Sequence[CollisionScene], field: DistanceMap | None) -> None:
        self._scenes, self._field = scenes, field
        self._kinds: list[int] = []
        self._sizes: list[Array] = []
        self._hulls: list[Hull | None] = []
        #: Meshes that nothing but a joint of the arms moves, with their poses on its body.
        self._rigid: dict[int, tuple[Mesh, Array]] = {}
        self._radii: list[float] = []
        self._bodies: list[int] = []
        self._poses: list[Array] = []
        self._keep: list[tuple[int, int, float]] = []
        self._covered: dict[int, float] = {}
        joints: dict[int, int] = {}
        for scene in scenes:
            joints.update({joint: len(joints) + k + 1 for k, joint in enumerate(scene.robot.joints)})
        links = len(scenes[0].robot.links)
        seen: set[tuple[int, int]] = set()
        for s, scene in enumerate(scenes):
            shapes, places = scene.shapes(), scene.joint_poses()
            parents = scene.robot.model.parents
            known = links if s else 0  # the robot's shapes are those of the first scene
            offset = len(self._kinds) - known
            index = {k: k if k < known else k + offset for k in range(len(shapes))}
            for joint, T, shape in shapes[known:]:
                self._add(joint, T, shape, places, parents, joints)
            for i, j, keep in scene.required():
                pair = (min(index[i], index[j]), max(index[i], index[j]))
                if pair not in seen:
                    seen.add(pair)
                    self._keep.append((*pair, keep + _ROUNDING))
            self._covered.update({index[k]: keep for k, keep in scene.map_clearance().items()})

    def _add(
        self,
        joint: int,
        T: Array,
        shape: Solid,
        places: list[Array],
        parents: Sequence[int],
        joints: dict[int, int],
    ) -> None:
        kind, size = _kind(shape)
        mover = joint
        while mover > 0 and mover not in joints:
            mover = parents[mover]
        body = joints.get(mover, 0)
        pose = places[joint] @ T if body == 0 else se3.inverse(places[mover]) @ places[joint] @ T
        if not isinstance(shape, Mesh):
            self._put(kind, size, body, pose)
            return
        if body > 0 and mover == joint:
            self._rigid[len(self._kinds)] = shape, pose
        self._put(kind, size, body, pose @ se3.make(None, shape.hull.centre), shape.hull)

    def _put(self, kind: int, size: Array, body: int, pose: Array, hull: Hull | None = None) -> None:
        self._kinds.append(kind)
        self._sizes.append(size)
        self._hulls.append(hull)
        self._radii.append(shape_radius(kind, size, _NO_CORNERS if hull is None else hull.corners))
        self._bodies.append(body)
        self._poses.append(pose[:3])

    def model(self) -> Model:
        """Everything as arrays."""
        chains = [scene.robot.kinematics for scene in self._scenes]
        parents: list[int] = []
        for chain in chains:
            parents += [0, *range(len(parents) + 1, len(parents) + chain.n)]
        placements = np.concatenate([chain.placements for chain in chains])
        prismatic = np.concatenate([chain.prismatic for chain in chains])
        ends = np.concatenate([np.maximum(np.abs(chain.lower), np.abs(chain.upper)) for chain in chains])
        swings = _Swings(parents, np.linalg.norm(placements[:, :3, 3], axis=1), prismatic, ends)
        clusters, of = self._clusters()
        hulls = self._cluster_hulls(clusters, of)
        groups, reaches, pairs, keep = self._groups(of, clusters, parents)
        moving = sum(cluster.body > 0 for cluster in clusters)
        still = [int(row[0]) for row in groups if row[1] >= moving]
        spheres, sphere_groups, bounds, covered = self._spheres()
        if self._field is not None:  # a cell of the map, which is put where it is when it is checked
            self._put(BOX, np.full(3, 0.5 * self._field.resolution), 0, np.eye(4))
        field = self._field or _NO_MAP
        corners, tips, firsts, rings = joined_corners(self._hulls)
        slack = float(np.sqrt(3.0)) * field.resolution
        need = float(spheres[:, 3].max(initial=0.0)) + slack
        if need > field.reach:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"distances of the map are cut at {field.reach:.3f} m, expected {need:.3f} m or more",
            )
        balls = [
            _Cluster(int(body), ball[:3], ball[3]) for (body, _, _), ball in zip(sphere_groups, bounds, strict=True)
        ]
        return Model(
            parents=np.array(parents, np.int64),
            placements=placements,
            axes=np.concatenate([chain.axes for chain in chains]),
            prismatic=prismatic,
            kinds=np.array(self._kinds, np.int64),
            sizes=np.array(self._sizes),
            corners=corners,
            tips=tips,
            firsts=firsts,
            rings=rings,
            radii=np.array(self._radii),
            bodies=np.array(self._bodies, np.int64),
            poses=np.array(self._poses),
            clusters=np.array([cluster.body for cluster in clusters], np.int64),
            centres=np.array([cluster.centre for cluster in clusters]),
            bounds=np.array([cluster.radius for cluster in clusters]),
            hulls=hulls,
            runs=np.searchsorted(still, np.arange(moving + 1)).astype(np.int64),
            groups=groups,
            points=np.array([clusters[b].centre for b in groups[:, 1]], np.float64).reshape(-1, 3).T.copy(),
            reaches=reaches,
            spans=reaches + np.array([clusters[a].radius + clusters[b].radius for a, b in groups[:, :2]]),
            swings=np.array([swings.of(c) for c in (*clusters[:moving], *balls)]).reshape(-1, len(parents)),
            pairs=pairs,
            keep=keep,
            spheres=spheres,
            sphere_groups=sphere_groups,
            sphere_bounds=bounds,
            sphere_shapes=covered[:, 0].astype(np.int64),
            sphere_keep=covered[:, 1].copy(),
            field=np.ascontiguousarray(field.distances, np.float32),
            corner=np.array(field.corner, np.float64),
            edge=np.array([field.resolution, slack]),
        )

    def _cover(self, k: int) -> Array:
        """Spheres (m, 4) that together hold a shape, in its frame."""
        hull, size = self._hulls[k], tuple(self._sizes[k].tolist())
        if hull is None:
            return cover(self._kinds[k], size)
        balls = cover(BOX, size)
        return balls[~hull.beyond(balls[:, :3], float(balls[0, 3]))]

    def _clusters(self) -> tuple[list[_Cluster], dict[int, int]]:
        """Put rigid meshes of a body into a cluster, its other shapes into another, each shape at rest into its own.

        Returns:
            The clusters, those that move first, and the cluster of each shape.
        """
        members: dict[tuple[int, int], list[int]] = {}
        for k, body in enumerate(self._bodies):
            members.setdefault((body, -int(k in self._rigid) if body else k), []).append(k)
        out: list[_Cluster] = []
        of: dict[int, int] = {}
        for (body, _), shapes in sorted(members.items(), key=lambda item: item[0][0] == 0):
            if len(shapes) == 1:
                of[shapes[0]] = len(out)
                out.append(_Cluster(body, self._poses[shapes[0]][:, 3], self._radii[shapes[0]]))
                continue
            places = np.array([self._poses[k][:, 3] for k in shapes])
            centre = 0.5 * (places.min(axis=0) + places.max(axis=0))
            radii = np.array([self._radii[k] for k in shapes])
            of.update(dict.fromkeys(shapes, len(out)))
            out.append(_Cluster(body, centre, float(np.max(np.linalg.norm(places - centre, axis=1) + radii))))
        return out, of

    def _cluster_hulls(self, clusters: Sequence[_Cluster], of: Mapping[int, int]) -> NDArray[np.int64]:
        """Return, by cluster, the shape that holds all of it: its only one, the hull of rigid meshes, or a box.

        Fingers and what they hold get a box, since they are somewhere else in each query.
        """
        members: list[list[int]] = [[] for _ in clusters]
        for k, cluster in of.items():
            members[cluster].append(k)
        out = np.full(len(clusters), -1, np.int64)
        for c, shapes in enumerate(members):
            out[c] = len(self._kinds)
            if len(shapes) == 1:
                out[c] = shapes[0]
            elif all(k in self._rigid for k in shapes):
                meshes, poses = zip(*(self._rigid[k] for k in shapes), strict=True)
                hull = _joined(meshes, np.array(poses).tobytes())
                self._put(HULL, hull.half, clusters[c].body, se3.make(None, hull.centre), hull)
            else:
                half, T = self._box_about(shapes)
                self._put(BOX, half, clusters[c].body, T)
        return out

    def _box_about(self, shapes: Sequence[int]) -> tuple[Array, Array]:
        """Return half edges (3,) and pose (4, 4) of the smallest box about shapes that is parallel to one of them."""
        points = np.concatenate([self._corners(k) @ self._poses[k][:, :3].T + self._poses[k][:, 3] for k in shapes])
        found: list[tuple[float, Array, Array]] = []
        for R in {self._poses[k][:, :3].round(6).tobytes(): self._poses[k][:, :3] for k in shapes}.values():
            turned = points @ R
            low, high = turned.min(axis=0), turned.max(axis=0)
            found.append((float(np.prod(high - low)), 0.5 * (high - low), se3.make(R, R @ (0.5 * (low + high)))))
        _, half, T = min(found, key=lambda item: item[0])
        return half, T

    def _corners(self, k: int) -> Array:
        """Return points (m, 3) whose hull holds a shape, in its frame."""
        hull, size = self._hulls[k], self._sizes[k]
        if hull is not None:
            return hull.corners
        half = {SPHERE: size[[0, 0, 0]], BOX: size}.get(self._kinds[k], size[[0, 0, 1]])
        return half * se3.BOX_CORNERS

    def _groups(
        self, of: dict[int, int], clusters: list[_Cluster], parents: Sequence[int]
    ) -> tuple[NDArray[np.int64], Array, NDArray[np.int64], Array]:
        if not self._keep:
            return np.empty((0, 6), np.int64), np.empty(0), np.empty((0, 2), np.int64), np.empty(0)
        cluster_of = np.array([of[k] for k in range(len(of))])
        lone = np.full(len(clusters), -1)
        for k, cluster in of.items():
            if clusters[cluster].body == 0:
                lone[cluster] = k
        i, j, keep = (np.array(column) for column in zip(*self._keep, strict=True))
        a, b = np.sort([cluster_of[i], cluster_of[j]], axis=0)  # what is at rest comes second
        order = np.lexsort((b, a, lone[b] < 0))
        a, b, keep = a[order], b[order], keep[order]
        first = np.flatnonzero(np.diff(a, prepend=-1) | np.diff(b, prepend=-1))
        a, b = a[first], b[first]
        common = [_carrier(clusters[x].body, clusters[y].body, parents) for x, y in zip(a, b, strict=True)]
        groups = np.stack([a, b, first, np.append(first[1:], len(order)), lone[b], common], axis=1)
        pairs = np.stack([i[order], j[order]], axis=1)
        return groups, np.maximum(np.maximum.reduceat(keep, first), 0.0), pairs, keep

    def _spheres(self) -> tuple[Array, NDArray[np.int64], Array, Array]:
        """Spheres that cover what moves, body by body; shape and clearance of each; empty without a map."""
        spheres: list[Array] = []
        shapes: list[Array] = []
        groups: list[tuple[int, int, int]] = []
        bounds: list[Array] = []
        bodies = sorted({self._bodies[k] for k in self._covered}) if self._field is not None else []
        count = 0
        for body in bodies:
            mine: list[Array] = []
            for k, keep in self._covered.items():
                if self._bodies[k] == body:
                    balls = self._cover(k)
                    p = balls[:, :3] @ self._poses[k][:, :3].T + self._poses[k][:, 3]
                    mine.append(np.column_stack([p, balls[:, 3] + keep]))
                    shapes.append(np.tile((float(k), keep + _ROUNDING), (len(balls), 1)))
            there = np.concatenate(mine)
            centre = 0.5 * (there[:, :3].min(axis=0) + there[:, :3].max(axis=0))
            bound = float(np.max(np.linalg.norm(there[:, :3] - centre, axis=1) + there[:, 3]))
            spheres.append(there)
            groups.append((body, count, count + len(there)))
            bounds.append(np.array([*centre, bound]))
            count += len(there)
        return (
            np.concatenate([np.empty((0, 4)), *spheres]),
            np.array(groups, np.int64).reshape(-1, 3),
            np.array(bounds, np.float64).reshape(-1, 4),
            np.concatenate([np.empty((0, 2)), *shapes]),
        )


@lru_cache(maxsize=64)
def _joined(meshes: tuple[Mesh, ...], poses: bytes) -> Hull:
    """The hull of meshes at poses (n, 4, 4) of one frame."""
    places = np.frombuffer(poses).reshape(-1, 4, 4)
    points = [mesh.vertices @ T[:3, :3].T + T[:3, 3] for mesh, T in zip(meshes, places, strict=True)]
    return Hull.of(np.concatenate(points))


def _carrier(a: int, b: int, parents: Sequence[int]) -> int:
    """The last body that carries both of two bodies, or is one of them."""
    while a != b:
        a, b = (parents[a - 1], b) if a > b else (a, parents[b - 1])
    return a


@lru_cache(maxsize=512)
def cover(kind: int, size: tuple[float, float, float]) -> Array:
    """Spheres (m, 4), centre and radius, that together hold a shape, in its frame."""
    if kind == SPHERE:
        return np.array([[0.0, 0.0, 0.0, size[0]]])
    half = np.array(size if kind == BOX else (size[0], size[0], size[1]))
    counts = np.maximum(np.ceil(2.0 * half / _CELL), 1).astype(int)
    cell = 2.0 * half / counts
    centres = -half + (np.indices(counts.tolist()).reshape(3, -1).T + 0.5) * cell
    if kind != BOX:  # without corners that the shape does not reach
        beyond = np.maximum(np.abs(centres[:, :2]) - 0.5 * cell[:2], 0.0)
        centres = centres[np.hypot(beyond[:, 0], beyond[:, 1]) <= size[0]]
    return np.column_stack([centres, np.full(len(centres), 0.5 * float(np.linalg.norm(cell)) + 1e-9)])


def _kind(shape: Solid) -> tuple[int, Array]:
    """Kind and sizes (3,) of a body as the kernels take them."""
    if isinstance(shape, Box):
        return BOX, 0.5 * shape.size
    if isinstance(shape, Cylinder):
        return CYLINDER, np.array([shape.radius, 0.5 * shape.length, 0.0])
    if isinstance(shape, Sphere):
        return SPHERE, np.array([shape.radius, 0.0, 0.0])
    if isinstance(shape, Mesh):
        return HULL, shape.hull.half
    raise OpenArmError(Code.INVALID_ARGUMENT, f"shape {type(shape).__name__}; valid: box, cylinder, sphere, mesh")
