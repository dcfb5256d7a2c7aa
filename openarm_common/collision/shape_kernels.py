# SPDX-License-Identifier: Apache-2.0
"""Numba kernel of two shapes: how far apart some axis proves them to be. m.

A shape is a box (half edges), a cylinder (radius, half length, axis z) or a sphere (radius) at a pose. Only axes that
are worth it are tried, so what is returned is proven while the true distance may be larger. Hulls have a kernel of
their own.
"""

from __future__ import annotations

import math

from openarm_common.kernels import bare_kernel, inlined_kernel
from openarm_common.types import Array, Ints

BOX, CYLINDER, SPHERE, HULL = 0, 1, 2, 3


@inlined_kernel
def _extent(kind: int, s0: float, s1: float, s2: float, x: float, y: float, z: float) -> float:
    """Half the extent of a shape of sizes s along a unit direction of its frame."""
    if kind == BOX:
        return s0 * abs(x) + s1 * abs(y) + s2 * abs(z)
    if kind == CYLINDER:
        return s1 * abs(z) + s0 * math.sqrt(max(0.0, 1.0 - z * z))
    return s0


@inlined_kernel
def _outside(kind: int, s0: float, s1: float, s2: float, x: float, y: float, z: float) -> float:
    """Distance of a point from a shape of sizes s, in its frame; < 0 inside."""
    if kind == BOX:
        dx, dy, dz = abs(x) - s0, abs(y) - s1, abs(z) - s2
        if dx <= 0.0 and dy <= 0.0 and dz <= 0.0:
            return max(dx, dy, dz)
        dx, dy, dz = max(dx, 0.0), max(dy, 0.0), max(dz, 0.0)
        return math.sqrt(dx * dx + dy * dy + dz * dz)
    if kind == CYLINDER:
        dr, dz = math.sqrt(x * x + y * y) - s0, abs(z) - s1
        if dr <= 0.0 and dz <= 0.0:
            return max(dr, dz)
        dr, dz = max(dr, 0.0), max(dz, 0.0)
        return math.sqrt(dr * dr + dz * dz)
    return math.sqrt(x * x + y * y + z * z) - s0


@inlined_kernel
def put_shape(k: int, bodies: Ints, poses: Array, frames: Array, done: Ints, world: Array) -> None:
    """Bring a shape to where its body is, once a state."""
    b, now = bodies[k], done[done.shape[0] - 1]
    if b > 0 and done[k] != now:
        done[k] = now
        for r in range(3):
            f0, f1, f2 = frames[b, r, 0], frames[b, r, 1], frames[b, r, 2]
            for c in range(4):
                world[k, r, c] = f0 * poses[k, 0, c] + f1 * poses[k, 1, c] + f2 * poses[k, 2, c]
            world[k, r, 3] += frames[b, r, 3]


@bare_kernel
def separation(i: int, j: int, enough: float, kinds: Ints, sizes: Array, world: Array) -> float:
    """Distance that two shapes are proven to keep (< 0: they overlap no deeper); searched until it is `enough`.

    Everything is in numbers, not in small arrays: those would cost more than the arithmetic.
    """
    ka, kb = kinds[i], kinds[j]
    a0, a1, a2 = sizes[i, 0], sizes[i, 1], sizes[i, 2]
    b0, b1, b2 = sizes[j, 0], sizes[j, 1], sizes[j, 2]
    dx, dy, dz = world[j, 0, 3] - world[i, 0, 3], world[j, 1, 3] - world[i, 1, 3], world[j, 2, 3] - world[i, 2, 3]
    # where the first is seen from the second (-u), and the second from the first (t), whose frame all else is in
    ux = world[j, 0, 0] * dx + world[j, 1, 0] * dy + world[j, 2, 0] * dz
    uy = world[j, 0, 1] * dx + world[j, 1, 1] * dy + world[j, 2, 1] * dz
    uz = world[j, 0, 2] * dx + world[j, 1, 2] * dy + world[j, 2, 2] * dz
    if ka == SPHERE:
        return _outside(kb, b0, b1, b2, ux, uy, uz) - a0
    tx = world[i, 0, 0] * dx + world[i, 1, 0] * dy + world[i, 2, 0] * dz
    ty = world[i, 0, 1] * dx + world[i, 1, 1] * dy + world[i, 2, 1] * dz
    tz = world[i, 0, 2] * dx + world[i, 1, 2] * dy + world[i, 2, 2] * dz
    if kb == SPHERE:
        return _outside(ka, a0, a1, a2, tx, ty, tz) - b0
    # the axes of the second are columns of c
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
    best = abs(tz) - _extent(ka, a0, a1, a2, 0.0, 0.0, 1.0) - _extent(kb, b0, b1, b2, c20, c21, c22)
    if best >= enough:
        return best
    if ka == BOX:
        best = max(best, abs(tx) - a0 - _extent(kb, b0, b1, b2, c00, c01, c02))
        if best >= enough:
            return best
        best = max(best, abs(ty) - a1 - _extent(kb, b0, b1, b2, c10, c11, c12))
        if best >= enough:
            return best
    best = max(best, abs(uz) - _extent(kb, b0, b1, b2, 0.0, 0.0, 1.0) - _extent(ka, a0, a1, a2, c02, c12, c22))
    if best >= enough:
        return best
    if kb == BOX:
        best = max(best, abs(ux) - b0 - _extent(ka, a0, a1, a2, c00, c10, c20))
        if best >= enough:
            return best
        best = max(best, abs(uy) - b1 - _extent(ka, a0, a1, a2, c01, c11, c21))
        if best >= enough:
            return best
    # from centre to centre, and straight away from the axes of cylinders
    norm = math.sqrt(tx * tx + ty * ty + tz * tz)
    if norm > 1e-9:
        gap = norm - _extent(ka, a0, a1, a2, tx / norm, ty / norm, tz / norm)
        best = max(best, gap - _extent(kb, b0, b1, b2, ux / norm, uy / norm, uz / norm))
        if best >= enough:
            return best
    if ka != BOX:
        norm = math.sqrt(tx * tx + ty * ty)
        if norm > 1e-6:
            x, y = tx / norm, ty / norm
            gap = norm - a0 - _extent(kb, b0, b1, b2, c00 * x + c10 * y, c01 * x + c11 * y, c02 * x + c12 * y)
            best = max(best, gap)
            if best >= enough:
                return best
    if kb != BOX:
        norm = math.sqrt(ux * ux + uy * uy)
        if norm > 1e-6:
            x, y = ux / norm, uy / norm
            gap = norm - b0 - _extent(ka, a0, a1, a2, c00 * x + c01 * y, c10 * x + c11 * y, c20 * x + c21 * y)
            best = max(best, gap)
            if best >= enough:
                return best
    # across an edge of each
    for m in range(0 if ka == BOX else 2, 3):
        for n in range(0 if kb == BOX else 2, 3):
            vx, vy, vz = (c00, c10, c20) if n == 0 else (c01, c11, c21) if n == 1 else (c02, c12, c22)
            x, y, z = (0.0, -vz, vy) if m == 0 else (vz, 0.0, -vx) if m == 1 else (-vy, vx, 0.0)
            norm = math.sqrt(x * x + y * y + z * z)
            if norm < 1e-4:
                continue
            x, y, z = x / norm, y / norm, z / norm
            gap = abs(tx * x + ty * y + tz * z) - _extent(ka, a0, a1, a2, x, y, z)
            u, v, w = c00 * x + c10 * y + c20 * z, c01 * x + c11 * y + c21 * z, c02 * x + c12 * y + c22 * z
            best = max(best, gap - _extent(kb, b0, b1, b2, u, v, w))
            if best >= enough:
                return best
    return best
