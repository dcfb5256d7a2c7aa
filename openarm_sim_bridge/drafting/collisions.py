# SPDX-License-Identifier: Apache-2.0
"""Hulls of a robot's shapes, links that a joint connects, and those that are mirror images of others. m."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import QhullError

from openarm_common import se3
from openarm_common.collision.hulls import Hull
from openarm_common.collision.self_collision import Pair
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.convex import hull_of
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.types import Array

#: Most triangles of a coarse hull, and grids that its corners move to, m.
_HULL_FACES, _GRIDS = 300, (0.001, 0.002, 0.003, 0.004, 0.006, 0.008, 0.012)


def corners_of(shape: Primitive) -> Array:
    """Return the corners (n, 3) of a shape, in the frame of its link; of a cylinder or sphere, of the box about it."""
    return se3.apply(shape.T_link_primitive, shape.points)


def hull_mesh(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices (n, 3) of the convex hull of points, and its triangles (m, 3) turned outwards.

    Points without a volume are given one.

    Raises:
        OpenArmError: CONFIG_INVALID, for points that have no hull in double precision.
    """
    try:
        hull = Hull.of(hull_of(points)[0])
    except QhullError as error:
        size = np.ptp(points, axis=0).max()
        raise OpenArmError(Code.CONFIG_INVALID, f"a shape {size:.3g} m long has no convex hull") from error
    return hull.centre + hull.corners, hull.triangles


def coarse_hull(points: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the hull of points, moved outwards to a grid until its triangles are few; see `hull_mesh`."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    out = hull_mesh(points)
    for cell in _GRIDS:
        if len(out[1]) <= _HULL_FACES:
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
