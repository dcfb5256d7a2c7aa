# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the fast collision layer: kinematics of bodies, separating axes, spheres in a distance field.

Shapes are boxes, cylinders and spheres on bodies; body 0 is the base, bodies 1..n follow the joints. Two shapes are
known to keep a distance when their projections on some axis are that far apart. Only axes that are worth it are tried,
so the answer "apart" is a proof while the answer "near" may be wrong. m, rad, base frame. The kernels release the GIL.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

BOX, CYLINDER, SPHERE = 0, 1, 2


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
        groups: (g, 5) clusters a and b, the first and last + 1 of their pairs, and b's shape if it is one that stands
            still, else -1.
        reaches: (g,) greatest distance that a pair of the group must keep.
        clusters: (c,) body of each cluster.
        centres: (c, 3) of the ball about a cluster, in its body.
        bounds: (c,) radius of that ball.
        pairs: (p, 2) shapes.
        keep: (p,) distance that each pair must keep.
        spheres: (k, 4) centre in its body and radius with clearance, of spheres that cover the moving shapes.
        sphere_groups: (m, 3) body, first and last + 1 of its spheres.
        sphere_bounds: (m, 4) ball about them.
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
    groups: Ints
    reaches: Array
    clusters: Ints
    centres: Array
    bounds: Array
    pairs: Ints
    keep: Array
    spheres: Array
    sphere_groups: Ints
    sphere_bounds: Array
    field: NDArray[np.float32]
    corner: Array
    edge: Array


class Work(NamedTuple):
    """Room: body poses (n + 1, 3, 4), shape poses (s, 3, 4), which of them are set (s,), centres (c, 3), a state."""

    frames: Array
    world: Array
    done: Ints
    middles: Array
    q: Array


@njit(cache=True, nogil=True)
def workspace(model: Model) -> Work:
    """Room for one thread."""
    n, s, c = model.parents.shape[0], model.kinds.shape[0], model.clusters.shape[0]
    frames = np.zeros((n + 1, 3, 4))
    for i in range(3):
        frames[0, i, i] = 1.0
    world = np.zeros((s, 3, 4))
    done = np.full(s, -1, np.int64)
    work = Work(frames, world, done, np.empty((c, 3)), np.empty(n))
    for k in range(s):  # what does not move is where it is
        if model.bodies[k] == 0:
            for row in range(3):
                for col in range(4):
                    world[k, row, col] = model.poses[k, row, col]
    return work


@njit(cache=True, nogil=True)
def _place(q: Array, model: Model, frames: Array) -> None:
    for i in range(model.parents.shape[0]):
        parent, place = frames[model.parents[i]], model.placements[i]
        x, y, z = model.axes[i, 0], model.axes[i, 1], model.axes[i, 2]
        out = frames[i + 1]
        c, s = 1.0, 0.0
        if not model.prismatic[i]:
            c, s = math.cos(q[i]), math.sin(q[i])
        v = 1.0 - c
        t00, t01, t02 = c + x * x * v, x * y * v - z * s, x * z * v + y * s
        t10, t11, t12 = y * x * v + z * s, c + y * y * v, y * z * v - x * s
        t20, t21, t22 = z * x * v - y * s, z * y * v + x * s, c + z * z * v
        for r in range(3):
            p0, p1, p2 = parent[r, 0], parent[r, 1], parent[r, 2]
            a0 = p0 * place[0, 0] + p1 * place[1, 0] + p2 * place[2, 0]
            a1 = p0 * place[0, 1] + p1 * place[1, 1] + p2 * place[2, 1]
            a2 = p0 * place[0, 2] + p1 * place[1, 2] + p2 * place[2, 2]
            out[r, 0] = a0 * t00 + a1 * t10 + a2 * t20
            out[r, 1] = a0 * t01 + a1 * t11 + a2 * t21
            out[r, 2] = a0 * t02 + a1 * t12 + a2 * t22
            out[r, 3] = p0 * place[0, 3] + p1 * place[1, 3] + p2 * place[2, 3] + parent[r, 3]
            if model.prismatic[i]:
                out[r, 3] += (a0 * x + a1 * y + a2 * z) * q[i]


@njit(cache=True, nogil=True, inline="always")
def _extent(kind: int, s0: float, s1: float, s2: float, x: float, y: float, z: float) -> float:
    """Half the extent of a shape of sizes s along a unit direction of its frame."""
    if kind == BOX:
        return s0 * abs(x) + s1 * abs(y) + s2 * abs(z)
    if kind == CYLINDER:
        return s1 * abs(z) + s0 * math.sqrt(max(0.0, 1.0 - z * z))
    return s0


@njit(cache=True, nogil=True)
def apart(i: int, j: int, keep: float, kinds: Ints, sizes: Array, world: Array) -> bool:
    """Whether two shapes are proven to be at least `keep` apart (< 0: to overlap no deeper).

    Everything is in numbers, not in small arrays: those would cost more than the arithmetic.
    """
    ka, kb = kinds[i], kinds[j]
    a0, a1, a2 = sizes[i, 0], sizes[i, 1], sizes[i, 2]
    b0, b1, b2 = sizes[j, 0], sizes[j, 1], sizes[j, 2]
    dx, dy, dz = world[j, 0, 3] - world[i, 0, 3], world[j, 1, 3] - world[i, 1, 3], world[j, 2, 3] - world[i, 2, 3]
    # all in the frame of the first: where the second is (t), and its axes (columns of c)
    tx = world[i, 0, 0] * dx + world[i, 1, 0] * dy + world[i, 2, 0] * dz
    ty = world[i, 0, 1] * dx + world[i, 1, 1] * dy + world[i, 2, 1] * dz
    tz = world[i, 0, 2] * dx + world[i, 1, 2] * dy + world[i, 2, 2] * dz
    c00 = world[i, 0, 0] * world[j, 0, 0] + world[i, 1, 0] * world[j, 1, 0] + world[i, 2, 0] * world[j, 2, 0]
    c01 = world[i, 0, 0] * world[j, 0, 1] + world[i, 1, 0] * world[j, 1, 1] + world[i, 2, 0] * world[j, 2, 1]
    c02 = world[i, 0, 0] * world[j, 0, 2] + world[i, 1, 0] * world[j, 1, 2] + world[i, 2, 0] * world[j, 2, 2]
    c10 = world[i, 0, 1] * world[j, 0, 0] + world[i, 1, 1] * world[j, 1, 0] + world[i, 2, 1] * world[j, 2, 0]
    c11 = world[i, 0, 1] * world[j, 0, 1] + world[i, 1, 1] * world[j, 1, 1] + world[i, 2, 1] * world[j, 2, 1]
    c12 = world[i, 0, 1] * world[j, 0, 2] + world[i, 1, 1] * world[j, 1, 2] + world[i, 2, 1] * world[j, 2, 2]
    c20 = world[i, 0, 2] * world[j, 0, 0] + world[i, 1, 2] * world[j, 1, 0] + world[i, 2, 2] * world[j, 2, 0]
    c21 = world[i, 0, 2] * world[j, 0, 1] + world[i, 1, 2] * world[j, 1, 1] + world[i, 2, 2] * world[j, 2, 1]
    c22 = world[i, 0, 2] * world[j, 0, 2] + world[i, 1, 2] * world[j, 1, 2] + world[i, 2, 2] * world[j, 2, 2]
    # normals of faces, axes of cylinders
    if abs(tz) - _extent(ka, a0, a1, a2, 0.0, 0.0, 1.0) - _extent(kb, b0, b1, b2, c20, c21, c22) >= keep:
        return True
    if ka == BOX:
        if abs(tx) - a0 - _extent(kb, b0, b1, b2, c00, c01, c02) >= keep:
            return True
        if abs(ty) - a1 - _extent(kb, b0, b1, b2, c10, c11, c12) >= keep:
            return True
    ux, uy, uz = tx * c00 + ty * c10 + tz * c20, tx * c01 + ty * c11 + tz * c21, tx * c02 + ty * c12 + tz * c22
    if abs(uz) - _extent(kb, b0, b1, b2, 0.0, 0.0, 1.0) - _extent(ka, a0, a1, a2, c02, c12, c22) >= keep:
        return True
    if kb == BOX:
        if abs(ux) - b0 - _extent(ka, a0, a1, a2, c00, c10, c20) >= keep:
            return True
        if abs(uy) - b1 - _extent(ka, a0, a1, a2, c01, c11, c21) >= keep:
            return True
    # from centre to centre, and straight away from the axes of cylinders
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    if norm > 1e-9:
        gap = norm - _extent(ka, a0, a1, a2, tx / norm, ty / norm, tz / norm)
        if gap - _extent(kb, b0, b1, b2, ux / norm, uy / norm, uz / norm) >= keep:
            return True
    if ka == CYLINDER:
        norm = math.sqrt(tx * tx + ty * ty)
        if norm > 1e-6:
            x, y = tx / norm, ty / norm
            gap = norm - a0 - _extent(kb, b0, b1, b2, c00 * x + c10 * y, c01 * x + c11 * y, c02 * x + c12 * y)
            if gap >= keep:
                return True
    if kb == CYLINDER:
        norm = math.sqrt(ux * ux + uy * uy)
        if norm > 1e-6:
            x, y = ux / norm, uy / norm
            gap = norm - b0 - _extent(ka, a0, a1, a2, c00 * x + c01 * y, c10 * x + c11 * y, c20 * x + c21 * y)
            if gap >= keep:
                return True
    if ka == SPHERE or kb == SPHERE:
        return False
    # across an edge of each
    for m in range(2 if ka == CYLINDER else 0, 3):
        for n in range(2 if kb == CYLINDER else 0, 3):
            vx, vy, vz = (c00, c10, c20) if n == 0 else (c01, c11, c21) if n == 1 else (c02, c12, c22)
            x, y, z = (0.0, -vz, vy) if m == 0 else (vz, 0.0, -vx) if m == 1 else (-vy, vx, 0.0)
            norm = math.sqrt(x * x + y * y + z * z)
            if norm < 1e-4:
                continue
            x, y, z = x / norm, y / norm, z / norm
            gap = abs(tx * x + ty * y + tz * z) - _extent(ka, a0, a1, a2, x, y, z)
            u, v, w = c00 * x + c10 * y + c20 * z, c01 * x + c11 * y + c21 * z, c02 * x + c12 * y + c22 * z
            if gap - _extent(kb, b0, b1, b2, u, v, w) >= keep:
                return True
    return False


@njit(cache=True, nogil=True)
def _shape(k: int, bodies: Ints, poses: Array, frames: Array, done: Ints, world: Array) -> None:
    """Bring a shape to where its body is, once a state."""
    b = bodies[k]
    if b == 0 or done[k] == 1:
        return
    done[k] = 1
    for r in range(3):
        f0, f1, f2 = frames[b, r, 0], frames[b, r, 1], frames[b, r, 2]
        for c in range(4):
            world[k, r, c] = f0 * poses[k, 0, c] + f1 * poses[k, 1, c] + f2 * poses[k, 2, c]
        world[k, r, 3] += frames[b, r, 3]


@njit(cache=True, nogil=True)
def near_pair(q: Array, model: Model, work: Work) -> int:
    """First pair that is not proven apart; -1 when all are; -2 when only the map is too near."""
    frames, world, done, middles = work.frames, work.world, work.done, work.middles
    kinds, sizes, radii, bodies, poses = model.kinds, model.sizes, model.radii, model.bodies, model.poses
    groups, reaches, clusters, centres, bounds = (
        model.groups,
        model.reaches,
        model.clusters,
        model.centres,
        model.bounds,
    )
    pairs, keep = model.pairs, model.keep
    _place(q, model, frames)
    for k in range(kinds.shape[0]):
        done[k] = 0
    for c in range(clusters.shape[0]):
        b = clusters[c]
        for r in range(3):
            middles[c, r] = (
                frames[b, r, 0] * centres[c, 0]
                + frames[b, r, 1] * centres[c, 1]
                + frames[b, r, 2] * centres[c, 2]
                + frames[b, r, 3]
            )
    for g in range(groups.shape[0]):
        a, b = groups[g, 0], groups[g, 1]
        x, y, z = middles[a, 0] - middles[b, 0], middles[a, 1] - middles[b, 1], middles[a, 2] - middles[b, 2]
        reach = bounds[a] + bounds[b] + reaches[g]
        if x * x + y * y + z * z > reach * reach:
            continue
        j = groups[g, 4]
        if j >= 0 and kinds[j] == BOX:  # a large one, say a table: its faces say more than the ball about it
            u = abs(x * world[j, 0, 0] + y * world[j, 1, 0] + z * world[j, 2, 0]) - sizes[j, 0]
            v = abs(x * world[j, 0, 1] + y * world[j, 1, 1] + z * world[j, 2, 1]) - sizes[j, 1]
            w = abs(x * world[j, 0, 2] + y * world[j, 1, 2] + z * world[j, 2, 2]) - sizes[j, 2]
            u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
            reach = bounds[a] + reaches[g]
            if u * u + v * v + w * w > reach * reach:
                continue
        for p in range(groups[g, 2], groups[g, 3]):
            i, j = pairs[p, 0], pairs[p, 1]
            _shape(i, bodies, poses, frames, done, world)
            _shape(j, bodies, poses, frames, done, world)
            x, y, z = world[i, 0, 3] - world[j, 0, 3], world[i, 1, 3] - world[j, 1, 3], world[i, 2, 3] - world[j, 2, 3]
            reach = max(radii[i] + radii[j] + keep[p], 0.0)
            if x * x + y * y + z * z <= reach * reach and not apart(i, j, keep[p], kinds, sizes, world):
                return p
    return -2 if _meets_map(model, work) else -1


@njit(cache=True, nogil=True)
def _cell(row: Array, ball: Array, corner: float, inverse: float) -> int:
    return math.floor((row[0] * ball[0] + row[1] * ball[1] + row[2] * ball[2] + row[3] - corner) * inverse)


@njit(cache=True, nogil=True)
def _meets_map(model: Model, work: Work) -> bool:
    nx, ny, nz = model.field.shape
    inverse, slack = 1.0 / model.edge[0], model.edge[1]
    for g in range(model.sphere_groups.shape[0]):
        frame = work.frames[model.sphere_groups[g, 0]]
        for k in range(model.sphere_groups[g, 1] - 1, model.sphere_groups[g, 2]):
            ball = model.sphere_bounds[g] if k < model.sphere_groups[g, 1] else model.spheres[k]
            # the nearest cell stands for a point outside: what is in the map is no nearer to the point than to it
            i = min(max(_cell(frame[0], ball, model.corner[0], inverse), 0), nx - 1)
            j = min(max(_cell(frame[1], ball, model.corner[1], inverse), 0), ny - 1)
            m = min(max(_cell(frame[2], ball, model.corner[2], inverse), 0), nz - 1)
            whole = k < model.sphere_groups[g, 1]
            near = model.field[i, j, m] < ball[3] + slack
            if whole and not near:
                break  # the ball about all of them is clear
            if not whole and near:
                return True
    return False


@njit(cache=True, nogil=True)
def states_free(states: Array, model: Model, out: NDArray[np.bool_]) -> None:
    """Whether each of the states (m, n) is proven free."""
    work = workspace(model)
    for k in range(states.shape[0]):
        out[k] = near_pair(states[k], model, work) == -1


@njit(cache=True, nogil=True)
def line_free(a: Array, b: Array, step: float, travel: float, levers: Array, model: Model, work: Work) -> bool:
    """Whether the joint line from `a` to `b` is free at steps as the exact layer takes them, far-apart points first."""
    largest, way = 0.0, 0.0
    for i in range(a.shape[0]):
        size = abs(b[i] - a[i])
        largest = max(largest, size)
        way += size * levers[i]
    n = math.ceil(max(largest / step, way / travel, 1.0))
    if near_pair(b, model, work) != -1 or near_pair(a, model, work) != -1:
        return False
    power = 1
    while power < n:
        power *= 2
    gap = power // 2
    while gap >= 1:
        for k in range(gap, min(power, n), 2 * gap):
            u = k / n
            for i in range(a.shape[0]):
                work.q[i] = a[i] + u * (b[i] - a[i])
            if near_pair(work.q, model, work) != -1:
                return False
        gap //= 2
    return True
