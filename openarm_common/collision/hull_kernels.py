# SPDX-License-Identifier: Apache-2.0
"""Numba kernel of two shapes of which one is a convex hull: how far apart some axis proves them to be. m.

The algorithm of Gilbert, Johnson and Keerthi ("A fast procedure for computing the distance between complex objects in
three-dimensional space", 1988): each step gives an axis, and what the shapes' extents along it prove is kept.
"""

from __future__ import annotations

import math

from openarm_common.collision.shape_kernels import BOX, HULL, SPHERE
from openarm_common.kernels import bare_kernel, inner_kernel
from openarm_common.types import Array, Ints

#: Steps at most; shapes that touch take the most.
_STEPS = 40
#: Share of the squared distance that an axis may leave unproven, and m2 below which a simplex holds the origin.
_CLOSE, _ZERO = 1e-3, 1e-14


@inner_kernel
def _climb(tip: int, corners: Array, firsts: Ints, rings: Ints, x: float, y: float, z: float) -> int:
    """The corner of a hull that is furthest along a direction of its frame, by edges that lead there from `tip`."""
    most = corners[tip, 0] * x + corners[tip, 1] * y + corners[tip, 2] * z
    while True:
        best = tip
        for r in range(firsts[tip], firsts[tip + 1]):
            c = rings[r]
            along = corners[c, 0] * x + corners[c, 1] * y + corners[c, 2] * z
            if along > most:
                best, most = c, along
        if best == tip:
            return tip
        tip = best


@inner_kernel
def _furthest(
    k: int, tip: int, kinds: Ints, sizes: Array, corners: Array, firsts: Ints, rings: Ints, world: Array,
    x: float, y: float, z: float,
) -> tuple[float, float, float, int]:  # fmt: skip
    """The furthest point of a shape along a direction of the base frame, and its corner; of a sphere, the centre."""
    kind = kinds[k]
    if kind == SPHERE:
        return world[k, 0, 3], world[k, 1, 3], world[k, 2, 3], tip
    u = world[k, 0, 0] * x + world[k, 1, 0] * y + world[k, 2, 0] * z
    v = world[k, 0, 1] * x + world[k, 1, 1] * y + world[k, 2, 1] * z
    w = world[k, 0, 2] * x + world[k, 1, 2] * y + world[k, 2, 2] * z
    if kind == HULL:
        tip = _climb(tip, corners, firsts, rings, u, v, w)
        u, v, w = corners[tip, 0], corners[tip, 1], corners[tip, 2]
    elif kind == BOX:
        u, v, w = math.copysign(sizes[k, 0], u), math.copysign(sizes[k, 1], v), math.copysign(sizes[k, 2], w)
    else:
        off = math.sqrt(u * u + v * v)
        share = sizes[k, 0] / off if off > 1e-12 else 0.0
        u, v, w = u * share, v * share, math.copysign(sizes[k, 1], w)
    px = world[k, 0, 0] * u + world[k, 0, 1] * v + world[k, 0, 2] * w + world[k, 0, 3]
    py = world[k, 1, 0] * u + world[k, 1, 1] * v + world[k, 1, 2] * w + world[k, 1, 3]
    pz = world[k, 2, 0] * u + world[k, 2, 1] * v + world[k, 2, 2] * w + world[k, 2, 3]
    return px, py, pz, tip


@bare_kernel
def hull_separation(
    p: int, i: int, j: int, keep: float, enough: float, kinds: Ints, sizes: Array, corners: Array, firsts: Ints,
    rings: Ints, world: Array, axes: Array, tips: Ints, room: Array,
) -> float:  # fmt: skip
    """Distance that two shapes are proven to keep, searched until it is `enough` or `keep` can't be reached.

    It starts with the axis that proved the most when the pair was last asked about, which mostly decides.

    Args:
        p: Row of the pair in `axes` and `tips`.
        i: A shape.
        j: Another one.
        keep: Distance below which it does not matter how near they are, m; < 0 allows overlap.
        enough: Distance beyond which it does not matter how far they are, m.
        kinds: See `Model`.
        sizes: See `Model`.
        corners: See `Model`.
        firsts: See `Model`.
        rings: See `Model`.
        world: (s, 3, 4) poses of shapes.
        axes: (pairs, 3) last axes, from the second shape to the first, in the frame of the second; 0 without one.
        tips: (pairs, 2) last corners of both shapes.
        room: (12, 3) for simplices.
    """
    # a sphere is its centre with a margin
    margin = (sizes[i, 0] if kinds[i] == SPHERE else 0.0) + (sizes[j, 0] if kinds[j] == SPHERE else 0.0)
    u, v, w = axes[p, 0], axes[p, 1], axes[p, 2]
    x = world[j, 0, 0] * u + world[j, 0, 1] * v + world[j, 0, 2] * w
    y = world[j, 1, 0] * u + world[j, 1, 1] * v + world[j, 1, 2] * w
    z = world[j, 2, 0] * u + world[j, 2, 1] * v + world[j, 2, 2] * w
    square = x * x + y * y + z * z
    if square < 0.5:
        x, y, z = world[i, 0, 3] - world[j, 0, 3], world[i, 1, 3] - world[j, 1, 3], world[i, 2, 3] - world[j, 2, 3]
        square = x * x + y * y + z * z
        if square < _ZERO:
            x, y, z, square = 1.0, 0.0, 0.0, 1.0
    a, b = tips[p, 0], tips[p, 1]
    best, count, bx, by, bz = -math.inf, 0, 0.0, 0.0, 0.0
    for _ in range(_STEPS):
        ax, ay, az, a = _furthest(i, a, kinds, sizes, corners, firsts, rings, world, -x, -y, -z)
        cx, cy, cz, b = _furthest(j, b, kinds, sizes, corners, firsts, rings, world, x, y, z)
        wx, wy, wz = ax - cx, ay - cy, az - cz
        along, norm = wx * x + wy * y + wz * z, math.sqrt(square)
        if along / norm - margin > best:
            best, bx, by, bz = along / norm - margin, x / norm, y / norm, z / norm
        if best >= enough or (count > 0 and (square - along <= _CLOSE * square or norm - margin < keep)):
            break
        room[count, 0], room[count, 1], room[count, 2] = wx, wy, wz
        count, x, y, z = _nearest(room, count + 1)
        square = x * x + y * y + z * z
        if count == 4 or square < _ZERO:
            break
    if best < enough and keep + margin < 0.0:  # they overlap, and may: what the axes of both prove
        for shape in range(2):
            k = i if shape == 0 else j
            for axis in range(6):
                sign = 1.0 if axis < 3 else -1.0
                x, y, z = sign * world[k, 0, axis % 3], sign * world[k, 1, axis % 3], sign * world[k, 2, axis % 3]
                ax, ay, az, a = _furthest(i, a, kinds, sizes, corners, firsts, rings, world, -x, -y, -z)
                cx, cy, cz, b = _furthest(j, b, kinds, sizes, corners, firsts, rings, world, x, y, z)
                best = max(best, (ax - cx) * x + (ay - cy) * y + (az - cz) * z - margin)
    tips[p, 0], tips[p, 1] = a, b
    axes[p, 0] = world[j, 0, 0] * bx + world[j, 1, 0] * by + world[j, 2, 0] * bz
    axes[p, 1] = world[j, 0, 1] * bx + world[j, 1, 1] * by + world[j, 2, 1] * bz
    axes[p, 2] = world[j, 0, 2] * bx + world[j, 1, 2] * by + world[j, 2, 2] * bz
    return best


@inner_kernel
def _nearest(s: Array, count: int) -> tuple[int, float, float, float]:
    """Reduce a simplex (its first `count` rows) to the face that is nearest to the origin; its size and that point."""
    if count == 1:
        return 1, s[0, 0], s[0, 1], s[0, 2]
    if count == 2:
        return _on_segment(s)
    if count == 3:
        return _on_triangle(s)
    # of the faces that have the origin outside, the one that is nearest
    found, fx, fy, fz = 4, 0.0, 0.0, 0.0
    least = math.inf
    p, kept = s[4:8], s[8:12]
    for m in range(4):
        for r in range(3):
            p[m, r] = s[m, r]
    for k in range(4):
        a, b, c = p[(k + 1) % 4], p[(k + 2) % 4], p[(k + 3) % 4]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        inner = nx * (p[k, 0] - a[0]) + ny * (p[k, 1] - a[1]) + nz * (p[k, 2] - a[2])
        outer = -(nx * a[0] + ny * a[1] + nz * a[2])
        if inner * outer > 0.0:
            continue
        for r in range(3):
            s[0, r], s[1, r], s[2, r] = a[r], b[r], c[r]
        size, x, y, z = _on_triangle(s)
        if x * x + y * y + z * z < least:
            least = x * x + y * y + z * z
            found, fx, fy, fz = size, x, y, z
            for m in range(size):
                for r in range(3):
                    kept[m, r] = s[m, r]
    for m in range(min(found, 3)):
        for r in range(3):
            s[m, r] = kept[m, r]
    return found, fx, fy, fz


@inner_kernel
def _on_segment(s: Array) -> tuple[int, float, float, float]:
    """As `_nearest`, of two points."""
    ux, uy, uz = s[1, 0] - s[0, 0], s[1, 1] - s[0, 1], s[1, 2] - s[0, 2]
    along, length = -(ux * s[0, 0] + uy * s[0, 1] + uz * s[0, 2]), ux * ux + uy * uy + uz * uz
    if along <= 0.0 or length <= 0.0:
        return 1, s[0, 0], s[0, 1], s[0, 2]
    if along >= length:
        _keep(s, 0, 1)
        return 1, s[0, 0], s[0, 1], s[0, 2]
    t = along / length
    return 2, s[0, 0] + t * ux, s[0, 1] + t * uy, s[0, 2] + t * uz


@inner_kernel
def _keep(s: Array, to: int, k: int) -> None:
    for r in range(3):
        s[to, r] = s[k, r]


@inner_kernel
def _on_triangle(s: Array) -> tuple[int, float, float, float]:
    """As `_nearest`, of three points, by the regions about the triangle (Ericson, "Real-time collision detection")."""
    ax, ay, az = s[0, 0], s[0, 1], s[0, 2]
    ux, uy, uz = s[1, 0] - ax, s[1, 1] - ay, s[1, 2] - az
    vx, vy, vz = s[2, 0] - ax, s[2, 1] - ay, s[2, 2] - az
    d1, d2 = -(ux * ax + uy * ay + uz * az), -(vx * ax + vy * ay + vz * az)
    if d1 <= 0.0 and d2 <= 0.0:
        return 1, ax, ay, az
    d3 = -(ux * s[1, 0] + uy * s[1, 1] + uz * s[1, 2])
    d4 = -(vx * s[1, 0] + vy * s[1, 1] + vz * s[1, 2])
    if d3 >= 0.0 and d4 <= d3:
        _keep(s, 0, 1)
        return 1, s[0, 0], s[0, 1], s[0, 2]
    d5 = -(ux * s[2, 0] + uy * s[2, 1] + uz * s[2, 2])
    d6 = -(vx * s[2, 0] + vy * s[2, 1] + vz * s[2, 2])
    if d6 >= 0.0 and d5 <= d6:
        _keep(s, 0, 2)
        return 1, s[0, 0], s[0, 1], s[0, 2]
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 <= d1 and d3 <= 0.0:
        return _on_segment(s)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 <= d2 and d6 <= 0.0:
        _keep(s, 1, 2)
        return _on_segment(s)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        _keep(s, 0, 2)
        return _on_segment(s)
    whole = va + vb + vc
    if whole <= 0.0:
        return _on_segment(s)
    v, w = vb / whole, vc / whole
    return 3, ax + v * ux + w * vx, ay + v * uy + w * vy, az + v * uz + w * vz
