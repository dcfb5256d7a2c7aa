# SPDX-License-Identifier: Apache-2.0
"""Whether a posture lets a robot touch itself: the shapes of the planner, all links, in some 0.1 ms. m, rad."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.collision.body_kernels import place_bodies, put_shape
from openarm_common.collision.hull_kernels import hull_separation
from openarm_common.collision.hulls import Hull, joined_corners
from openarm_common.collision.shape_kernels import BOX, CYLINDER, HULL, SPHERE, separation
from openarm_common.kernels import kernel
from openarm_common.robot.bodies import Bodies
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.urdf import Joint, Primitive
from openarm_common.types import Array, Ints

#: Distances are searched up to this one, m.
_FAR = 0.02
#: Random states in which links that always touch must do so, as in the planner.
_SAMPLES = 1000


@dataclass(frozen=True)
class Nearest:
    """The two links that are nearest to each other: negative where they overlap; `_FAR` where none is near."""

    first: str
    second: str
    distance: float


class SelfCollision:
    """Checks postures of a robot. Not for two threads at once.

    Args:
        description: The robot.
        joint_names: Order of the joints of postures; others are at 0, followers follow.
    """

    def __init__(self, description: RobotDescription, joint_names: Sequence[str]) -> None:
        joints = _in_order(description)
        body = {description.root: 0} | {joint.child: i + 1 for i, joint in enumerate(joints)}
        self._share, self._offset = _followed(joints, joint_names)
        at = Bodies.of(description)
        fixed = {link: _from_body(description, link) for link in description.links}
        found = [(name, shape) for name, link in description.links.items() for shape in link.collision]
        self._links = [name for name, _ in found]
        packed = [_packed(shape) for _, shape in found]
        kinds, sizes, hulls, poses = zip(*packed, strict=True) if packed else ((), (), (), ())
        self._tree = (
            np.array([body[at.body[joint.parent]] for joint in joints], np.int64),
            np.array([fixed[joint.parent] @ joint.T_parent_joint for joint in joints]).reshape(-1, 4, 4),
            np.array([joint.axis / np.linalg.norm(joint.axis) for joint in joints]).reshape(-1, 3),
            np.array([joint.type == "prismatic" for joint in joints], np.bool_),
        )
        none = np.empty((0, 3))
        radii = [shape_radius(kind, size, hull.corners if hull else none) for kind, size, hull, _ in packed]
        bodies = np.array([body[at.body[name]] for name in self._links], np.int64)
        placed = [fixed[name] @ T for name, T in zip(self._links, poses, strict=True)]
        self._shapes = (
            np.array(kinds, np.int64),
            np.array(sizes).reshape(-1, 3),
            *joined_corners(hulls),
            np.array(radii),
            bodies,
            np.array(placed).reshape(-1, 4, 4)[:, :3].copy(),
        )
        self._frames = np.zeros((len(joints) + 1, 3, 4))
        self._frames[0, :3, :3] = np.eye(3)
        self._world = self._shapes[-1].copy()
        self._done = np.zeros(len(found) + 1, np.int64)
        self._room = np.empty((12, 3))
        n = len(found)
        pairs = [(i, j) for i in range(n) for j in range(i) if at.checked(self._links[i], self._links[j])]
        self._pairs: Ints = np.array(pairs, np.int64).reshape(-1, 2)
        self._pairs = self._pairs[~self._always(joints)]

    def distances(self, q: Array) -> Array:
        """Return the distances (p,) of the pairs of shapes that must not touch, at most `_FAR`, in a posture (n,)."""
        return self.distances_of(q, self._pairs)

    def distances_of(self, q: Array, pairs: Ints) -> Array:
        """Return the same of some of `pairs_of_links`, (k, 2)."""
        return self._distances(self._share @ q + self._offset, pairs)

    def pairs_of_links(self) -> dict[tuple[str, str], Ints]:
        """Return the pairs of shapes (k, 2) that must not touch, by the links that they belong to."""
        found = dict[tuple[str, str], list[Ints]]()
        for pair in self._pairs:
            found.setdefault((self._links[pair[0]], self._links[pair[1]]), []).append(pair)
        return {links: np.array(pairs) for links, pairs in found.items()}

    def nearest(self, distances: Array) -> Nearest:
        """Return the nearest pair of `distances`."""
        if not len(distances):
            return Nearest("", "", _FAR)
        k = int(np.argmin(distances))
        first, second = (self._links[i] for i in self._pairs[k])
        return Nearest(first, second, float(distances[k]))

    def _distances(self, full: Array, pairs: Ints) -> Array:
        out = np.empty(len(pairs))
        _measure(full, self._tree, self._shapes, pairs, self._frames, self._world, self._done, self._room, out)
        return out

    def _always(self, joints: Sequence[Joint]) -> NDArray[np.bool_]:
        """Return which pairs touch in every sample: that is how the shapes are drawn."""
        touching = np.ones(len(self._pairs), np.bool_)
        low = np.array([max(joint.lower, -math.pi) for joint in joints])
        high = np.array([min(joint.upper, math.pi) for joint in joints])
        rng = np.random.default_rng(0)
        for _ in range(_SAMPLES):
            if not touching.any():
                break
            touching[touching] = self._distances(rng.uniform(low, high), self._pairs[touching]) <= 0.0
        return touching


def shape_radius(kind: int, size: Array, corners: Array) -> float:
    """Return the radius of the ball about a shape, m.

    Args:
        kind: See `shape_kernels`.
        size: (3,) see there.
        corners: (n, 3) of a hull.
    """
    if kind == CYLINDER:
        return float(np.hypot(size[0], size[1]))
    if kind == HULL:
        return float(np.linalg.norm(corners, axis=1).max())
    return float(np.linalg.norm(size)) if kind == BOX else float(size[0])


def _packed(shape: Primitive) -> tuple[int, Array, Hull | None, Array]:
    """Return kind, sizes (3,), hull and pose in its link (4, 4) of a shape as the kernels take it."""
    T = shape.T_link_primitive
    if shape.corners is not None:
        hull = Hull.of(shape.corners)
        return HULL, hull.half, hull, T @ se3.make(None, hull.centre)
    if shape.kind == "box":
        return BOX, 0.5 * np.array(shape.size), None, T
    if shape.kind == "cylinder":
        return CYLINDER, np.array([shape.size[0], 0.5 * shape.size[1], 0.0]), None, T
    return SPHERE, np.array([shape.size[0], 0.0, 0.0]), None, T


def _in_order(description: RobotDescription) -> list[Joint]:
    """Return the movable joints, each after those that carry it."""
    found = dict[str, Joint]()
    for link in description.links:
        found |= {joint.name: joint for joint in description.chain(link) if joint.type != "fixed"}
    return list(found.values())


def _followed(joints: Sequence[Joint], names: Sequence[str]) -> tuple[Array, Array]:
    """Return A (m, n) and b (m,): positions of all joints are A q + b."""
    column = {name: k for k, name in enumerate(names)}
    share, offset = np.zeros((len(joints), len(names))), np.zeros(len(joints))
    for i, joint in enumerate(joints):
        leader = joint.mimic or joint.name
        if leader in column:
            share[i, column[leader]] = 1.0 if joint.mimic is None else joint.multiplier
        offset[i] = 0.0 if joint.mimic is None else joint.offset
    return share, offset


def _from_body(description: RobotDescription, link: str) -> Array:
    """Return the pose (4, 4) of a link in the first link of its rigid body."""
    T = np.eye(4)
    for joint in description.chain(link):
        T = T @ joint.T_parent_joint if joint.type == "fixed" else np.eye(4)
    return T


@kernel
def _measure(
    q: Array,
    tree: tuple[Ints, Array, Array, NDArray[np.bool_]],
    shapes: tuple[Ints, Array, Array, Ints, Ints, Ints, Array, Ints, Array],
    pairs: Ints,
    frames: Array,
    world: Array,
    done: Ints,
    room: Array,
    out: Array,
) -> None:
    parents, placements, axes, prismatic = tree
    kinds, sizes, corners, tips, firsts, rings, radii, bodies, poses = shapes
    past, at = np.zeros((1, 3)), np.zeros((1, 2), np.int64)
    place_bodies(q, parents, placements, axes, prismatic, frames)
    done[-1] += 1
    for p in range(pairs.shape[0]):
        i, j = pairs[p, 0], pairs[p, 1]
        put_shape(i, bodies, poses, frames, done, world)
        put_shape(j, bodies, poses, frames, done, world)
        x, y, z = world[i, 0, 3] - world[j, 0, 3], world[i, 1, 3] - world[j, 1, 3], world[i, 2, 3] - world[j, 2, 3]
        reach = radii[i] + radii[j] + _FAR
        if x * x + y * y + z * z >= reach * reach:
            out[p] = _FAR
            continue
        hull = kinds[i] == HULL or kinds[j] == HULL
        proven = -math.inf if hull else separation(i, j, _FAR, kinds, sizes, world)
        if proven < _FAR:
            past[0, 0] = past[0, 1] = past[0, 2] = 0.0  # a posture has nothing to do with the one before
            at[0, 0], at[0, 1] = tips[i], tips[j]
            more = hull_separation(
                0, i, j, -math.inf, _FAR, kinds, sizes, corners, firsts, rings, world, past, at, room
            )
            proven = max(proven, more)
        out[p] = min(proven, _FAR)
