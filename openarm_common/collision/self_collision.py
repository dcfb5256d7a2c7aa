# SPDX-License-Identifier: Apache-2.0
"""How near links of a robot are to each other in a posture, by the shapes of the planner, in some 0.1 ms. m, rad."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from openarm_common import se3
from openarm_common.collision.hull_kernels import hull_separation
from openarm_common.collision.hulls import joined_corners
from openarm_common.collision.shape_kernels import BOX, CYLINDER, HULL, SPHERE, put_shape, separation
from openarm_common.kernels import kernel
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.robot.tree import KinematicTree, TreeArrays
from openarm_common.robot.tree_kernels import place_bodies, unplaced
from openarm_common.types import Array, Ints, Mask

#: Two links, by name.
Pair = frozenset[str]
#: Distances of links that must not touch are searched up to this one, m; of links that may, up to what is a contact.
_FAR, _BEYOND = 0.02, 1e-6
#: States in which links must touch that always do.
_ALWAYS = 1000
_FREE: Mapping[str, float] = MappingProxyType({})


class LinkDistances:
    """Shapes of a robot, and pairs of them on different rigid bodies. Not for two threads at once.

    Args:
        description: The robot; collision meshes are hulls, see `RobotDescription.from_files`.
        tree: Its links and joints; it says the order of the joints of postures.
        far: Distances are searched up to this one, m.
        checked: Whether the shapes of two links make pairs.

    Attributes:
        pairs: (p, 2) shapes.
        owners: Link of each shape.
    """

    def __init__(
        self,
        description: RobotDescription,
        tree: KinematicTree,
        far: float,
        checked: Callable[[str, str], bool] = lambda first, second: True,
    ) -> None:
        self._tree, self._far = tree, far
        found = [(name, shape) for name, link in description.links.items() for shape in link.collision]
        self.owners = [name for name, _ in found]
        packed = [_packed(shape) for _, shape in found]
        kinds, sizes, poses = zip(*packed, strict=True) if packed else ((), (), ())
        hulls = [shape.hull for _, shape in found]
        none = np.empty((0, 3))
        radii = [
            shape_radius(kind, size, hull.corners if hull else none)
            for kind, size, hull in zip(kinds, sizes, hulls, strict=True)
        ]
        bodies = np.array([tree.body[name] for name in self.owners], np.int64)
        placed = [tree.fixed[name] @ T for name, T in zip(self.owners, poses, strict=True)]
        self._shapes = (
            np.array(kinds, np.int64),
            np.array(sizes).reshape(-1, 3),
            *joined_corners(hulls),
            np.array(radii),
            bodies,
            np.array(placed).reshape(-1, 4, 4)[:, :3].copy(),
        )
        self._frames = unplaced(len(tree.joints))
        self._world = self._shapes[-1].copy()
        self._done = np.zeros(len(found) + 1, np.int64)
        self._room = np.empty((12, 3))
        pairs = ((i, j) for i in range(len(found)) for j in range(i) if bodies[i] != bodies[j])
        pairs = [(i, j) for i, j in pairs if checked(self.owners[i], self.owners[j])]
        self.pairs: Ints = np.array(pairs, np.int64).reshape(-1, 2)

    def distances_of(self, q: Array, pairs: Ints) -> Array:
        """Return the distances (k,) of some of the pairs (k, 2) in a posture (n,), at most `far`."""
        out, state = np.empty(len(pairs)), self._tree.positions(q)
        rooms = (self._frames, self._world, self._done, self._room)
        _measure(state, self._tree.arrays, self._shapes, pairs, self._far, *rooms, out)
        return out


class LinkContacts(LinkDistances):
    """Pairs of links that can move to each other, and whether they touch. Not for two threads at once.

    Args:
        description: The robot; collision meshes are hulls, see `RobotDescription.from_files`.
        margin: Links that are nearer to each other touch, m.
        every: Whether links that may touch make pairs, too.
    """

    def __init__(self, description: RobotDescription, margin: float = 0.0, *, every: bool = True) -> None:
        leaders = [joint for joint in description.joints.values() if joint.type != "fixed" and joint.mimic is None]
        self._names = [joint.name for joint in leaders]
        tree = KinematicTree(description, self._names)
        super().__init__(description, tree, margin + _BEYOND, lambda a, b: every or tree.checked(a, b))
        self._low = np.array([max(joint.lower, -math.pi) for joint in leaders])
        self._high = np.array([min(joint.upper, math.pi) for joint in leaders])
        self._margin = margin
        named = [frozenset((self.owners[i], self.owners[j])) for i, j in self.pairs.tolist()]
        self._links = list(dict.fromkeys(named))
        number = {pair: k for k, pair in enumerate(self._links)}
        #: Pair of links that each pair of shapes is of.
        self._of = np.array([number[pair] for pair in named], np.int64)

    def touching(self, samples: int, seed: int) -> set[Pair]:
        """Return the pairs of links that touch in at least one random state."""
        left, rng = np.ones(len(self._links), np.bool_), np.random.default_rng(seed)
        for _ in range(samples):
            left &= ~self._hits(rng.uniform(self._low, self._high), left)
        return self._named(~left)

    def always_touching(self, share: float = 1.0, held: Mapping[str, float] = _FREE) -> set[Pair]:
        """Return the pairs of links that touch in every random state.

        Args:
            share: Share of the states in which they touch, at least.
            held: Positions of joints that stay there.
        """
        misses, rng = np.full(len(self._links), round((1.0 - share) * _ALWAYS)), np.random.default_rng(0)
        for _ in range(_ALWAYS):
            if not (misses >= 0).any():
                break
            drawn = zip(self._names, rng.uniform(self._low, self._high).tolist(), strict=True)
            misses -= ~self._hits(self._posture({**dict(drawn), **held}), misses >= 0)
        return self._named(misses >= 0)

    def at(self, state: Mapping[str, float]) -> set[Pair]:
        """Return the pairs of links that touch in a state; joints that it does not name are at 0, followers follow."""
        return self._named(self._hits(self._posture(state), np.ones(len(self._links), np.bool_)))

    def _posture(self, state: Mapping[str, float]) -> Array:
        return np.array([state.get(name, 0.0) for name in self._names])

    def _hits(self, q: Array, among: Mask) -> Mask:
        """Return which pairs of links touch in a posture (n,); only some are looked at."""
        rows, out = np.flatnonzero(among[self._of]), np.zeros(len(self._links), np.bool_)
        out[self._of[rows[self.distances_of(q, self.pairs[rows]) <= self._margin]]] = True
        return out

    def _named(self, chosen: Mask) -> set[Pair]:
        return {self._links[k] for k in np.flatnonzero(chosen)}


@lru_cache(maxsize=8)
def always_touching(description: RobotDescription) -> frozenset[Pair]:
    """Return the pairs of links that must not touch and do in every random state: that is how they are drawn."""
    return frozenset(LinkContacts(description, every=False).always_touching())


@dataclass(frozen=True)
class Nearest:
    """The two links that are nearest to each other: negative where they overlap; `_FAR` where none is near."""

    first: str
    second: str
    distance: float


class SelfCollision(LinkDistances):
    """Checks postures of a robot. Not for two threads at once.

    Args:
        description: The robot.
        joint_names: Order of the joints of postures; others are at 0, followers follow.
    """

    def __init__(self, description: RobotDescription, joint_names: Sequence[str]) -> None:
        tree, always = KinematicTree(description, joint_names), always_touching(description)

        def checked(first: str, second: str) -> bool:
            return tree.checked(first, second) and frozenset((first, second)) not in always

        super().__init__(description, tree, _FAR, checked)

    def distances(self, q: Array) -> Array:
        """Return the distances (p,) of the pairs of shapes that must not touch, at most `_FAR`, in a posture (n,)."""
        return self.distances_of(q, self.pairs)

    def pairs_of_links(self) -> dict[tuple[str, str], Ints]:
        """Return the pairs of shapes (k, 2) that must not touch, by the links that they belong to."""
        found = dict[tuple[str, str], list[Ints]]()
        for pair in self.pairs:
            found.setdefault((self.owners[pair[0]], self.owners[pair[1]]), []).append(pair)
        return {links: np.array(pairs) for links, pairs in found.items()}

    def nearest(self, distances: Array) -> Nearest:
        """Return the nearest pair of `distances`."""
        if not len(distances):
            return Nearest("", "", _FAR)
        k = int(np.argmin(distances))
        first, second = (self.owners[i] for i in self.pairs[k])
        return Nearest(first, second, float(distances[k]))


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


def _packed(shape: Primitive) -> tuple[int, Array, Array]:
    """Return kind, sizes (3,) and pose in its link (4, 4) of a shape as the kernels take it."""
    T = shape.T_link_primitive
    if shape.hull is not None:
        return HULL, shape.hull.half, T @ se3.make(None, shape.hull.centre)
    if shape.kind == "box":
        return BOX, shape.half, T
    if shape.kind == "cylinder":
        return CYLINDER, np.array([shape.size[0], 0.5 * shape.size[1], 0.0]), T
    return SPHERE, np.array([shape.size[0], 0.0, 0.0]), T


@kernel
def _measure(
    q: Array,
    tree: TreeArrays,
    shapes: tuple[Ints, Array, Array, Ints, Ints, Ints, Array, Ints, Array],
    pairs: Ints,
    far: float,
    frames: Array,
    world: Array,
    done: Ints,
    room: Array,
    out: Array,
) -> None:
    parents, placements, axes, prismatic = tree
    kinds, sizes, corners, tips, firsts, rings, radii, bodies, poses = shapes
    past, at = np.zeros((1, 3)), np.zeros((1, 2), np.int64)
    place_bodies(q, parents, placements, axes, prismatic, frames, np.empty((parents.shape[0], 6)))
    done[-1] += 1
    for p in range(pairs.shape[0]):
        i, j = pairs[p, 0], pairs[p, 1]
        put_shape(i, bodies, poses, frames, done, world)
        put_shape(j, bodies, poses, frames, done, world)
        x, y, z = world[i, 0, 3] - world[j, 0, 3], world[i, 1, 3] - world[j, 1, 3], world[i, 2, 3] - world[j, 2, 3]
        reach = radii[i] + radii[j] + far
        if x * x + y * y + z * z >= reach * reach:
            out[p] = far
            continue
        hull = kinds[i] == HULL or kinds[j] == HULL
        proven = -math.inf if hull else separation(i, j, far, kinds, sizes, world)
        if proven < far:
            past[0, 0] = past[0, 1] = past[0, 2] = 0.0  # a posture has nothing to do with the one before
            at[0, 0], at[0, 1] = tips[i], tips[j]
            more = hull_separation(0, i, j, -math.inf, far, kinds, sizes, corners, firsts, rings, world, past, at, room)
            proven = max(proven, more)
        out[p] = min(proven, far)
