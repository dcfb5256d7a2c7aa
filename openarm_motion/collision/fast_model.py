# SPDX-License-Identifier: Apache-2.0
"""A scene as the kernels of the fast collision layer take it, and the room of one thread. m, rad, base frame.

Shapes are boxes, cylinders and spheres on bodies; body 0 is the base, bodies 1..n follow the joints. Shapes of one
body are a cluster with a ball about it; two clusters whose shapes are to be looked at are a group.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.types import Array, Ints

#: Numbers that a list of groups or intervals of a line has room for.
_ROOM = 1 << 15


class Model(NamedTuple):
    """A scene as the kernels take it.

    Attributes:
        parents: (n,) body that joint i hangs on; joint i moves body i + 1.
        placements: (n, 4, 4) of each joint in its parent body at zero.
        axes: (n, 3) unit, in the joint's frame.
        prismatic: (n,) bool.
        kinds: (s,) BOX, CYLINDER or SPHERE.
        sizes: (s, 3) half edges; radius, half length; radius.
        radii: (s,) of the ball about the shape's centre that holds it.
        bodies: (s,) body of each shape.
        poses: (s, 3, 4) of each shape in its body.
        clusters: (c,) body of each cluster; those that move come first.
        centres: (c, 3) of the ball about a cluster, in its body.
        bounds: (c,) radius of that ball.
        runs: (moving clusters + 1,) where the groups of each moving cluster with clusters that stand still begin.
        groups: (g, 5) clusters a (moving) and b, the first and last + 1 of their pairs, and b's shape if it is one
            that stands still, else -1; groups of two moving clusters come last.
        points: (3, g) centre of cluster b where it stands still.
        reaches: (g,) greatest distance that a pair of the group must keep.
        spans: (g,) the same with the radii of both balls.
        swings: (g + m, n) how far, at most, a point of cluster a (of a body's spheres) moves as seen by cluster b (the
            map) when a joint turns by 1 rad, m.
        pairs: (p, 2) shapes.
        keep: (p,) distance that each pair must keep.
        spheres: (k, 4) centre in its body and radius with clearance, of spheres that cover the moving shapes.
        sphere_groups: (m, 3) body, first and last + 1 of its spheres.
        sphere_bounds: (m, 4) ball about them.
        sphere_shapes: (k,) the shape that each sphere covers a part of; with a map, the last shape is a cell of it.
        sphere_keep: (k,) distance that the shape must keep from the map.
        field: (x, y, z) float32 distances to occupied cells, of one cell when there is no map.
        corner: (3,) lower corner of the field.
        edge: (2,) edge of a cell, and what rounding to cells takes off a distance.
    """

    parents: Ints
    placements: Array
    axes: Array
    prismatic: NDArray[np.bool_]
    kinds: Ints
    sizes: Array
    radii: Array
    bodies: Ints
    poses: Array
    clusters: Ints
    centres: Array
    bounds: Array
    runs: Ints
    groups: Ints
    points: Array
    reaches: Array
    spans: Array
    swings: Array
    pairs: Ints
    keep: Array
    spheres: Array
    sphere_groups: Ints
    sphere_bounds: Array
    sphere_shapes: Ints
    sphere_keep: Array
    field: NDArray[np.float32]
    corner: Array
    edge: Array


class Work(NamedTuple):
    """Room for one thread.

    Attributes:
        frames: (n + 1, 3, 4) poses of bodies.
        world: (s, 3, 4) poses of shapes.
        done: (s + 1,) the number of the state that each shape was last placed for; the last one is that number.
        middles: (c, 3) centres of clusters.
        near: (g,) flags.
        sways: (g + m,) how far things come nearer over a line, m.
        lists: Numbers of groups.
        spans: (k, 4) intervals of a line: first and last point, where the list of its groups begins, its length.
        q: (n,) a state.
    """

    frames: Array
    world: Array
    done: Ints
    middles: Array
    near: NDArray[np.uint8]
    sways: Array
    lists: Ints
    spans: Ints
    q: Array


@njit(cache=True, nogil=True)
def workspace(model: Model) -> Work:
    """Room for one thread."""
    n, s, c, g = model.parents.shape[0], model.kinds.shape[0], model.clusters.shape[0], model.groups.shape[0]
    frames = np.zeros((n + 1, 3, 4))
    for i in range(3):
        frames[0, i, i] = 1.0
    world, middles = np.zeros((s, 3, 4)), np.zeros((c, 3))
    work = Work(
        frames,
        world,
        np.zeros(s + 1, np.int64),
        middles,
        np.empty(g, np.uint8),
        np.zeros(model.swings.shape[0]),
        np.empty(_ROOM, np.int64),
        np.empty((_ROOM, 4), np.int64),
        np.empty(n),
    )
    for k in range(s):  # what does not move is where it is
        if model.bodies[k] == 0:
            world[k] = model.poses[k]
    for k in range(c):
        middles[k] = model.centres[k]
    return work
