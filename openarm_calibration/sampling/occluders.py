# SPDX-License-Identifier: Apache-2.0
"""Whether the robot hides something from a camera.

Hiding goes by boxes around the collision shapes and, where a shape is a hull, by its faces, a little larger than the
shapes. This sorts postures out before a planner is asked, fast and roughly. Root frame, m.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from scipy.spatial import ConvexHull

from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

#: Added to half edges.
_SKIN = 0.004


class Occluders:
    """The collision shapes of a robot.

    Args:
        description: The robot.
    """

    def __init__(self, description: RobotDescription) -> None:
        shapes = [(name, shape) for name, link in description.links.items() for shape in link.collision]
        self._links = [name for name, _ in shapes]
        self._T_link_shape: Array = np.array([shape.T_link_primitive for _, shape in shapes]).reshape(-1, 4, 4)
        half = np.array([shape.half for _, shape in shapes]).reshape(-1, 3)
        self._large: Array = half + _SKIN
        #: Faces (k, 4) of hulls by index, moved outwards by the same: normal, and minus its distance from the origin.
        self._faces: dict[int, Array] = {
            i: ConvexHull(shape.corners).equations - (0.0, 0.0, 0.0, _SKIN)
            for i, (_, shape) in enumerate(shapes)
            if shape.corners is not None
        }

    def place(self, links: Mapping[str, Array]) -> Array:
        """Return (n, 4, 4) poses of the shapes for poses (4, 4) of the links."""
        return np.array([links[name] for name in self._links]).reshape(-1, 4, 4) @ self._T_link_shape

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
