# SPDX-License-Identifier: Apache-2.0
"""Which links of a robot touch: in random states, in all of them, and in given ones. m, rad."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import ConvexHull, QhullError

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.robot.convex import hull_of
from openarm_common.robot.description import Joint, Primitive, RobotDescription
from openarm_common.types import Array

Pair = frozenset[str]
#: States in which links must touch that always do.
_ALWAYS = 1000
_FREE: Mapping[str, float] = MappingProxyType({})
#: Most triangles of a coarse hull, and grids that its corners move to, m.
_HULL_FACES, _GRIDS = 300, (0.001, 0.002, 0.003, 0.004, 0.006, 0.008, 0.012)
#: Most triangles at a corner that coal takes.
_NEIGHBOURS = 255


class LinkContacts:
    """The collision shapes of a robot, with all pairs of links that can move to each other.

    Args:
        description: The robot; collision meshes are hulls, see `RobotDescription.from_files`.
        margin: Links that are nearer to each other touch, m.

    Raises:
        OpenArmError: CONFIG_INVALID, when pinocchio does not read the URDF.
    """

    def __init__(self, description: RobotDescription, margin: float = 0.0) -> None:
        try:
            self._model = pin.buildModelFromXML(description.urdf)
        except ValueError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"pinocchio does not read the URDF: {said(error)}") from error
        self._geometry, owner = pin.GeometryModel(), list[str]()
        for link in description.links.values():
            frame = self._model.frames[self._model.getFrameId(link.name, pin.FrameType.BODY)]
            for shape in link.collision:
                placement = frame.placement * pin.SE3(shape.T_link_primitive)
                name = f"{shape.name} {len(owner)}"
                item = pin.GeometryObject(name, frame.parentJoint, placement, coal_shape(shape))
                self._geometry.addGeometryObject(item)
                owner.append(link.name)
        self._geometry.addAllCollisionPairs()
        self._pairs = [frozenset((owner[p.first], owner[p.second])) for p in self._geometry.collisionPairs]
        ends = np.array([(p.first, p.second) for p in self._geometry.collisionPairs], np.int64).reshape(-1, 2)
        self._first, self._second = ends.T
        shapes = [item.geometry for item in self._geometry.geometryObjects]
        for shape in shapes:
            shape.computeLocalAABB()
        #: Of a ball around each shape: its centre in the frame of the shape.
        self._centres = [shape.aabb_center for shape in shapes]
        radii = np.array([shape.aabb_radius for shape in shapes])
        #: Shapes of a pair with centres that are further apart do not touch.
        self._apart = radii[self._first] + radii[self._second] + margin
        self._data, self._placed = self._model.createData(), self._geometry.createData()
        for request in self._placed.collisionRequests:
            request.security_margin = margin
        joints = {joint.name: self._model.joints[self._model.getJointId(joint.name)] for joint in _moving(description)}
        self._columns = {name: joint.idx_q for name, joint in joints.items()}
        self._endless = {name for name, joint in joints.items() if joint.nq == 2}
        self._followers = [joint for joint in _moving(description) if joint.mimic is not None]

    def touching(self, samples: int, seed: int) -> set[Pair]:
        """Return the pairs of links that touch in at least one random state."""
        left, found = set(self._pairs), set[Pair]()
        rng = np.random.default_rng(seed)
        for _ in range(samples):
            hits = self._hits(self._random(rng), left)
            found |= hits
            left -= hits
        return found

    def always_touching(self, share: float = 1.0, held: Mapping[str, float] = _FREE) -> set[Pair]:
        """Return the pairs of links that touch in every random state.

        Args:
            share: Share of the states in which they touch, at least.
            held: Positions of joints that stay there.
        """
        left = dict.fromkeys(self._pairs, round((1.0 - share) * _ALWAYS))
        rng = np.random.default_rng(0)
        for _ in range(_ALWAYS):
            q = self._random(rng)
            for name, value in held.items():
                self._put(q, name, value)
            hits = self._hits(self._followed(q), set(left))
            left = {pair: free - (pair not in hits) for pair, free in left.items() if free or pair in hits}
        return set(left)

    def at(self, state: Mapping[str, float]) -> set[Pair]:
        """Return the pairs of links that touch in a state; joints that it does not name are at 0, followers follow."""
        q: Array = np.array(pin.neutral(self._model))
        for name, value in state.items():
            self._put(q, name, value)
        return self._hits(self._followed(q), set(self._pairs))

    def _random(self, rng: np.random.Generator) -> Array:
        q = rng.uniform(self._model.lowerPositionLimit, self._model.upperPositionLimit)
        for name in self._endless:
            self._put(q, name, np.pi * q[self._columns[name]])
        return self._followed(q)

    def _put(self, q: Array, name: str, value: float) -> None:
        k = self._columns[name]
        if name in self._endless:  # pinocchio keeps a continuous joint as cosine and sine
            q[k : k + 2] = np.cos(value), np.sin(value)
        else:
            q[k] = value

    def _followed(self, q: Array) -> Array:
        for joint in self._followers:
            q[self._columns[joint.name]] = joint.multiplier * q[self._columns[str(joint.mimic)]] + joint.offset
        return q

    def _hits(self, q: Array, among: set[Pair]) -> set[Pair]:
        pin.updateGeometryPlacements(self._model, self._data, self._geometry, self._placed, q)
        placed = zip(self._placed.oMg, self._centres, strict=True)
        centres = np.array([T.act(centre) for T, centre in placed]).reshape(-1, 3)
        away = centres[self._first] - centres[self._second]
        found = set[Pair]()
        for k in np.flatnonzero(np.einsum("ij,ij->i", away, away) <= self._apart**2).tolist():
            pair = self._pairs[k]
            if pair in among and pair not in found and pin.computeCollision(self._geometry, self._placed, k):
                found.add(pair)
        return found


def coal_shape(shape: Primitive) -> coal.CollisionGeometry:
    """Return a shape for coal, in its own frame."""
    if shape.corners is not None:
        points, triangles = coarse_hull(shape.corners, _fits_coal)
        corners, faces = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
        corners.extend(list(points))
        faces.extend([coal.Triangle(*triangle) for triangle in triangles.tolist()])
        return coal.Convex(corners, faces)
    if shape.kind == "box":
        return coal.Box(*shape.size)
    return coal.Cylinder(*shape.size) if shape.kind == "cylinder" else coal.Sphere(*shape.size)


def corners_of(shape: Primitive) -> Array:
    """Return the corners (n, 3) of a shape, in the frame of its link; of a cylinder or sphere, of the box about it."""
    corners = shape.corners
    if corners is None:
        size = shape.size
        edges = {"box": size, "cylinder": (2.0 * size[0], 2.0 * size[0], size[-1]), "sphere": (2.0 * size[0],) * 3}
        corners = 0.5 * np.array(edges[shape.kind]) * np.array(np.meshgrid(*[(-1.0, 1.0)] * 3)).reshape(3, -1).T
    return se3.apply(shape.T_link_primitive, corners)


def _fits_coal(triangles: NDArray[np.int64]) -> bool:
    return int(np.bincount(triangles.ravel()).max()) <= _NEIGHBOURS


def hull_mesh(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices (n, 3) of the convex hull of points, and its triangles (m, 3) turned outwards.

    Points without a volume are given one.

    Raises:
        OpenArmError: CONFIG_INVALID, for points that have no hull in double precision.
    """
    points = hull_of(points)[0]
    try:
        hull = ConvexHull(points)
    except QhullError as error:
        size = np.ptp(points, axis=0).max()
        raise OpenArmError(Code.CONFIG_INVALID, f"a shape {size:.3g} m long has no convex hull") from error
    index = np.full(len(points), -1, np.int64)
    index[hull.vertices] = np.arange(len(hull.vertices))
    a, b, c = (points[hull.simplices[:, k]] for k in range(3))
    inwards = np.einsum("ij,ij->i", np.cross(b - a, c - a), hull.equations[:, :3]) < 0.0
    triangles = index[hull.simplices]
    triangles[inwards] = triangles[inwards][:, ::-1]
    return points[hull.vertices], triangles


def coarse_hull(
    points: Array, enough: Callable[[NDArray[np.int64]], bool] = lambda triangles: len(triangles) <= _HULL_FACES
) -> tuple[Array, NDArray[np.int64]]:
    """Return the hull of points, moved outwards to a grid until its triangles are `enough`; see `hull_mesh`."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    out = hull_mesh(points)
    for cell in _GRIDS:
        if enough(out[1]):
            break
        away = points - middle
        moved = middle + np.sign(away) * np.ceil(np.abs(away) / cell) * cell
        out = hull_mesh(np.unique(moved.round(6), axis=0))
    return out


def adjacent_pairs(description: RobotDescription) -> set[Pair]:
    """Links with shapes that a joint connects, directly or over links without shapes."""
    pairs: set[Pair] = set()
    for name, link in description.links.items():
        if link.collision:
            parents = [j.parent for j in description.chain(name) if description.links[j.parent].collision]
            if parents:
                pairs.add(frozenset((parents[-1], name)))
    return pairs


def mirror_links(description: RobotDescription) -> dict[str, str]:
    """Return the link of the mirror image of each link.

    Of two arms that are mirror images (y negated in the base frame) they are assigned to each other by their places in
    the zero posture; of several at one place it is the one of the same rank. Other links are their own image.
    """
    same = {name: name for name in description.links}
    if len(description.arms) != 2 or not description.mirror:
        return same
    zero = dict.fromkeys(description.joints, 0.0)
    T_base_root = np.linalg.inv(description.link_pose(description.base, zero))
    places = {name: (T_base_root @ T)[:3, 3] for name, T in description.link_poses(zero).items()}
    arms = [description.links_of(arm) for arm in description.arm_names]
    first, second = (np.array([places[link] for link in links]) for links in arms)
    away = np.linalg.norm((first * (1.0, -1.0, 1.0))[:, None] - second, axis=2)
    away += 1e-6 * np.abs(np.subtract.outer(np.arange(len(first)), np.arange(len(second))))
    for i, k in zip(*linear_sum_assignment(away), strict=True):
        same[arms[0][i]], same[arms[1][k]] = arms[1][k], arms[0][i]
    return same


def _moving(description: RobotDescription) -> list[Joint]:
    return [joint for joint in description.joints.values() if joint.type != "fixed"]
