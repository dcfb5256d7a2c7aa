# SPDX-License-Identifier: Apache-2.0
"""Many postures at once: where a link is; whether the robot hides something from a camera, or is in its own way.

Contact goes by boxes around the collision shapes, hiding by boxes and, where a shape is a hull, by its faces. This
sorts postures out before a planner is asked, fast and roughly: for contact the boxes are a little smaller than the
shapes, for sight they are a little larger. Root frame, m.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import ConvexHull

from openarm_calibration.handeye.transforms import exps
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: Added to half edges for sight, and taken off for contact.
_SKIN = 0.004
#: A cylinder's box for contact: between the one inside and the one around it.
_CYLINDER = 0.85


def chain_poses(description: RobotDescription, link: str, q: Array) -> Array:
    """Return poses (n, 4, 4) of a link for the movable joints of its chain (n, joints), rad or m.

    Args:
        description: The robot.
        link: End of the chain.
        q: (n, joints).
    """
    T = np.broadcast_to(np.eye(4), (len(q), 4, 4))
    column = 0
    for joint in description.chain(link):
        T = T @ joint.T_parent_joint
        if joint.type == "fixed":
            continue
        motion = np.broadcast_to(np.eye(4), (len(q), 4, 4)).copy()
        along = q[:, column, None] * joint.axis
        if joint.type == "prismatic":
            motion[:, :3, 3] = along
        else:
            motion[:, :3, :3] = exps(along)
        T = T @ motion
        column += 1
    return np.array(T)


class Bodies:
    """The collision shapes of a robot.

    Args:
        description: The robot.
    """

    def __init__(self, description: RobotDescription) -> None:
        shapes = [(name, shape) for name, link in description.links.items() for shape in link.collision]
        self._links = [name for name, _ in shapes]
        self._T_link_shape: Array = np.array([shape.T_link_primitive for _, shape in shapes]).reshape(-1, 4, 4)
        box = np.array([shape.kind == "box" for _, shape in shapes], bool)[:, None]
        # edges of a box, or radius and length of a cylinder
        edges = [s.size if s.kind == "box" else (2.0 * s.size[0], 2.0 * s.size[0], s.size[1]) for _, s in shapes]
        half = np.array(edges).reshape(-1, 3) / 2.0
        self._large: Array = half + _SKIN
        self._small: Array = np.maximum(half * np.where(box, 1.0, (_CYLINDER, _CYLINDER, 1.0)) - _SKIN, 1e-4)
        #: Faces (k, 4) of hulls by index, moved outwards by the same: normal, and minus its distance from the origin.
        self._faces: dict[int, Array] = {
            i: ConvexHull(shape.corners).equations - (0.0, 0.0, 0.0, _SKIN)
            for i, (_, shape) in enumerate(shapes)
            if shape.corners is not None
        }
        allowed = description.allowed_collisions
        pairs = [
            (i, j)
            for i in range(len(shapes))
            for j in range(i + 1, len(shapes))
            if self._links[i] != self._links[j] and frozenset((self._links[i], self._links[j])) not in allowed
        ]
        self._one, self._other = np.array(pairs, dtype=np.intp).reshape(-1, 2).T

    def place(self, links: Mapping[str, Array]) -> Array:
        """Return (n, 4, 4) poses of the shapes for poses (4, 4) of the links."""
        return np.array([links[name] for name in self._links]).reshape(-1, 4, 4) @ self._T_link_shape

    def touching(self, shapes: Array) -> bool:
        """Return whether two shapes of different links overlap that may not; `shapes` from `place`."""
        a, b = shapes[self._one], shapes[self._other]
        h, k = self._small[self._one], self._small[self._other]
        Ra, Rb = a[:, :3, :3], b[:, :3, :3]
        apart = b[:, :3, 3] - a[:, :3, 3]
        near = np.linalg.norm(apart, axis=1) < np.linalg.norm(h, axis=1) + np.linalg.norm(k, axis=1)
        if not near.any():
            return False
        Ra, Rb, apart, h, k = Ra[near], Rb[near], apart[near], h[near], k[near]
        # separating axes: the faces' normals, and the products of the edges
        edges = np.cross(Ra.swapaxes(1, 2)[:, :, None], Rb.swapaxes(1, 2)[:, None]).reshape(-1, 9, 3)
        axes = np.concatenate([Ra.swapaxes(1, 2), Rb.swapaxes(1, 2), edges], axis=1)
        reach = np.abs(axes @ Ra) @ h[:, :, None] + np.abs(axes @ Rb) @ k[:, :, None]
        separated = np.abs(axes @ apart[:, :, None]) > reach
        return bool((~separated.any(axis=(1, 2))).any())

    def hidden(self, shapes: Array, eye: Array, points: Array) -> bool:
        """Return whether a shape lies between the eye (3,) and any of the points (n, 3); `shapes` from `place`.

        What the eye is in is the mount of the camera, which hides nothing.

        Args:
            shapes: (n, 4, 4), from `place`.
            eye: (3,), m.
            points: (n, 3), m.
        """
        inverse = shapes[:, :3, :3].swapaxes(1, 2)
        start = (inverse @ (eye - shapes[:, :3, 3])[:, :, None])[:, None, :, 0]
        ends = (points[None] - shapes[:, None, :3, 3]) @ shapes[:, :3, :3]
        way = ends - start
        way = np.where(np.abs(way) < 1e-12, 1e-12, way)
        half = self._large[:, None]
        one, other = (-half - start) / way, (half - start) / way
        enter, leave = np.minimum(one, other).max(axis=2), np.maximum(one, other).min(axis=2)
        met = (enter <= leave) & (leave > 0.0) & (enter < 1.0)
        return any(
            _meets(self._faces[i], start[i, 0], way[i]) if i in self._faces else bool((met[i] & (enter[i] > 0.0)).any())
            for i in np.flatnonzero(met.any(axis=1)).tolist()
        )


def _meets(faces: Array, start: Array, ways: Array) -> bool:
    """Return whether one of the lines from a point (3,) outside along ways (n, 3) meets a hull of faces (k, 4)."""
    speed, above = ways @ faces[:, :3].T, faces[:, :3] @ start + faces[:, 3]
    at = -above / np.where(np.abs(speed) < 1e-12, 1e-12, speed)
    enter = np.where(speed < 0.0, at, -np.inf).max(axis=1)
    leave = np.where(speed > 0.0, at, np.inf).min(axis=1)
    outside = ((np.abs(speed) < 1e-12) & (above > 0.0)).any(axis=1)
    return bool(((enter <= leave) & (enter > 0.0) & (enter < 1.0) & ~outside).any())
