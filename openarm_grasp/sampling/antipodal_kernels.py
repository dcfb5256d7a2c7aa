# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the search for antipodal grasps.

Coordinates are in voxels: voxel (i, j, k) reaches from (i, j, k) to (i + 1, j + 1, k + 1); the table is z = 0.
A hand has its approach along z and opens along y.
"""

from __future__ import annotations

import math

import numpy as np

from openarm_common.kernels import kernel
from openarm_common.types import Array, Bytes, Floats, Ints
from openarm_grasp.sampling.voxel_kernels import FILLED, FREE, OTHER, SEEN

#: Lattice of rays between the pads: across, and along the fingers.
_ACROSS, _ALONG = 8, 9
#: Pads give: what is this near to the first contact touches, voxels.
_SOFT = 1.3
#: Rounds that turn the closing axis; slopes of the sides that need no turn, and that are no side that pads meet.
_ROUNDS, _STRAIGHT, _CROOKED = 3, 0.03, 0.5
#: The far side is left when so many steps of half a voxel are not of the object.
_GONE = 4

#: A side that was not seen may reach so much farther out, voxels.
_MOST_UNSEEN = 5
#: Rays whose first contact is this near to the first of all say how the side of the object is turned, voxels.
_FLAT = 4.0
#: A hand that stands at its clearance over the table is this much above it, voxels.
_ROUNDING = 0.05
#: Rays that must touch each pad.
_LEAST_TOUCH = 3.0

#: Columns of `found`: pose (12), width, narrowest, touching share, alignment, certainty, how far unseen sides may reach
#: out, slope of the line between the patches, lever, off the middle, tilt, in shadow, room, pair, finger of the hand.
COLUMNS = 26
WIDTH, NARROW, TOUCH, ALIGN, SURE, UNSEEN, SLOPE, LEVER, ASIDE, TILT, BLIND, ROOM, PAIR, OPENING = range(12, 26)


@kernel
def _cell(cells: Bytes, x: float, y: float, z: float) -> int:
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    if i < 0 or j < 0 or k < 0 or i >= cells.shape[0] or j >= cells.shape[1] or k >= cells.shape[2]:
        return FREE
    return cells[i, j, k]


@kernel
def _pair(
    cells: Bytes, normals: Floats, px: float, py: float, pz: float, dx: float, dy: float, dz: float, last: float,
    widest: float, near: float, least_cos: float, out: Array, count: int,
) -> int:  # fmt: skip
    """Write the pair of a start and the end of the object at a distance from it, unless it is none.

    Returns:
        How many pairs there are.
    """
    if last < 0.5 or last > widest or count == out.shape[0]:
        return count
    qx, qy, qz = px + dx * last, py + dy * last, pz + dz * last
    n = normals[math.floor(qx), math.floor(qy), math.floor(qz)]
    far = n[0] * dx + n[1] * dy + n[2] * dz
    if far < least_cos:
        return count
    row = out[count]
    row[0], row[1], row[2] = 0.5 * (px + qx), 0.5 * (py + qy), 0.5 * (pz + qz)
    row[3], row[4], row[5], row[6], row[7] = dx, dy, dz, last, min(near, far)
    return count + 1


@kernel
def pairs(cells: Bytes, normals: Floats, starts: Ints, lean: float, widest: float, least_cos: float, out: Array) -> int:
    """Find opposite contacts: from each start through the object, level and along the normal.

    Args:
        cells: (nx, ny, nz).
        normals: (nx, ny, nz, 3).
        starts: (n, 3) voxels at the boundary of the target.
        lean: Closing axes that rise by more (sine) are left out.
        widest: Voxels.
        least_cos: Both normals are at most this far (cosine) from the closing axis: the friction cone.
        out: (4 n, 8) rows: middle (3), closing axis (3), width, alignment.

    Returns:
        How many.
    """
    count = 0
    for s in range(starts.shape[0]):
        i, j, k = starts[s, 0], starts[s, 1], starts[s, 2]
        nx, ny, nz = normals[i, j, k, 0], normals[i, j, k, 1], normals[i, j, k, 2]
        level = math.hypot(nx, ny)
        if level < 0.3:
            continue
        for way in range(2):
            if way == 0:
                dx, dy, dz = -nx / level, -ny / level, 0.0
            elif 0.15 < abs(nz) < lean:
                dx, dy, dz = -nx, -ny, -nz
            else:
                break
            near = -(nx * dx + ny * dy + nz * dz)
            if near < least_cos:
                continue
            px, py, pz = i + 0.5, j + 0.5, k + 0.5
            at, last, gone = 0.0, -1.0, 0
            while at < widest + 3.0:
                what = _cell(cells, px + dx * at, py + dy * at, pz + dz * at)
                if what in (SEEN, FILLED):
                    last, gone = at, 0
                else:
                    gone += 1
                    if gone == _GONE:
                        count = _pair(cells, normals, px, py, pz, dx, dy, dz, last, widest, near, least_cos, out, count)
                at += 0.5
            if gone < _GONE or last < 0.0:  # it goes on farther than the hand opens
                continue
            # what is hollow has a wall beyond, and another pair across both
            count = _pair(cells, normals, px, py, pz, dx, dy, dz, last, widest, near, least_cos, out, count)
    return count


@kernel
def _hits(obstacles: Bytes, hand: Array, T: Array, px: float, py: float, pz: float, floor: float, stride: int) -> int:
    """Return how many points of a hand (n, 3), turned as T and at p, are in the target's shadow.

    It is -1 when one is in an obstacle or below `floor`.
    """
    blind = 0
    nx, ny, nz = obstacles.shape
    for n in range(0, hand.shape[0], stride):
        z = T[2, 0] * hand[n, 0] + T[2, 1] * hand[n, 1] + T[2, 2] * hand[n, 2] + pz
        if z < floor:
            return -1
        if z >= nz:
            continue
        x = T[0, 0] * hand[n, 0] + T[0, 1] * hand[n, 1] + T[0, 2] * hand[n, 2] + px
        y = T[1, 0] * hand[n, 0] + T[1, 1] * hand[n, 1] + T[1, 2] * hand[n, 2] + py
        i, j, k = math.floor(x), math.floor(y), math.floor(z)
        if i < 0 or j < 0 or k < 0 or i >= nx or j >= ny:
            continue
        what = obstacles[i, j, k]
        if what == 2:
            blind += 1
        elif what != 0:
            return -1
    return blind


@kernel
def _between(cells: Bytes, T: Array, pad: Array, opening: float, first: Array, last: Array) -> bool:
    """March between the open pads: where each ray first and last meets the target; NaN where it does not.

    Returns:
        False, when something else is between the pads.
    """
    for a in range(_ACROSS):
        x = pad[0] + (pad[1] - pad[0]) * a / (_ACROSS - 1)
        for b in range(_ALONG):
            z = pad[2] + (pad[3] - pad[2]) * b / (_ALONG - 1)
            bx = T[0, 0] * x + T[0, 2] * z + T[0, 3]
            by = T[1, 0] * x + T[1, 2] * z + T[1, 3]
            bz = T[2, 0] * x + T[2, 2] * z + T[2, 3]
            first[a, b], last[a, b] = math.nan, math.nan
            if bz >= cells.shape[2] + abs(T[2, 1]) * opening:
                continue
            y = -opening
            while y <= opening:
                what = _cell(cells, bx + T[0, 1] * y, by + T[1, 1] * y, bz + T[2, 1] * y)
                if what == OTHER:
                    return False
                if what in (SEEN, FILLED):
                    if math.isnan(first[a, b]):
                        first[a, b] = y
                    last[a, b] = y
                y += 0.5
    return True


@kernel
def _unseen(cells: Bytes, x: float, y: float, z: float, dx: float, dy: float, dz: float) -> int:
    """How far a contact may lie farther out (d): voxels of shadow before it; 0 for one that was seen."""
    if _cell(cells, x, y, z) == SEEN:
        return 0
    for n in range(2, 1 + _MOST_UNSEEN):
        if _cell(cells, x + n * dx, y + n * dy, z + n * dz) == FREE:
            return 0 if n == 2 else n - 1  # next to an edge a voxel of shadow says nothing
    return _MOST_UNSEEN


@kernel
def _turn(pad: Array, first: Array, last: Array) -> float:
    """Slope of the sides of the object across the pads, by least squares: dy / dx, mean of both sides."""
    low, high = math.inf, -math.inf
    for a in range(_ACROSS):
        for b in range(_ALONG):
            if not math.isnan(first[a, b]):
                low, high = min(low, first[a, b]), max(high, last[a, b])
    total, sides = 0.0, 0
    for side in range(2):
        n = sx = sy = sxx = sxy = 0.0
        for a in range(_ACROSS):
            x = pad[0] + (pad[1] - pad[0]) * a / (_ACROSS - 1)
            for b in range(_ALONG):
                y = first[a, b] if side == 0 else last[a, b]
                if math.isnan(y) or (y - low if side == 0 else high - y) > _FLAT:
                    continue
                n, sx, sy, sxx, sxy = n + 1.0, sx + x, sy + y, sxx + x * x, sxy + x * y
        spread = n * sxx - sx * sx
        if n >= 4.0 and spread > 1.0:
            total += (n * sxy - sx * sy) / spread
            sides += 1
    return total / sides if sides else 0.0


@kernel
def _touch(cells: Bytes, normals: Floats, T: Array, pad: Array, first: Array, last: Array, out: Array) -> bool:
    """Measure the contact patches of both pads: the columns of `found` from WIDTH to SLOPE."""
    low, high = math.inf, -math.inf
    for a in range(_ACROSS):
        for b in range(_ALONG):
            if not math.isnan(first[a, b]):
                low, high = min(low, first[a, b]), max(high, last[a, b])
    if high < low:
        return False
    narrow = high - low
    count, sure, unseen, mean = np.zeros(2), np.zeros(2), np.zeros(2), np.zeros((2, 3))
    where, where_seen, seen = np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2)
    for a in range(_ACROSS):
        x = pad[0] + (pad[1] - pad[0]) * a / (_ACROSS - 1)
        for b in range(_ALONG):
            if math.isnan(first[a, b]):
                continue
            z = pad[2] + (pad[3] - pad[2]) * b / (_ALONG - 1)
            touching = 0
            for side in range(2):
                y = first[a, b] if side == 0 else last[a, b]
                if (y - low if side == 0 else high - y) > _SOFT:
                    continue
                touching += 1
                cx = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
                cy = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
                cz = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
                n = normals[math.floor(cx), math.floor(cy), math.floor(cz)]
                if _cell(cells, cx, cy, cz - 1.0) in (SEEN, FILLED):  # the rim of what is flat is no slope
                    n = normals[math.floor(cx), math.floor(cy), math.floor(cz) - 1]
                count[side] += 1.0
                for axis in range(3):
                    mean[side, axis] += n[axis]
                out_y = -1.0 if side == 0 else 1.0
                far = _unseen(cells, cx, cy, cz, T[0, 1] * out_y, T[1, 1] * out_y, T[2, 1] * out_y)
                unseen[side] += far
                where[side, 0] += x
                where[side, 1] += z
                if far == 0:
                    sure[side] += 1.0
                if _cell(cells, cx, cy, cz) == SEEN:
                    seen[side] += 1.0
                    where_seen[side, 0] += x
                    where_seen[side, 1] += z
            if touching == 2:
                narrow = min(narrow, last[a, b] - first[a, b])
    if min(count[0], count[1]) < _LEAST_TOUCH:
        return False
    align = 1.0
    for side in range(2):
        along = (mean[side, 0] * T[0, 1] + mean[side, 1] * T[1, 1] + mean[side, 2] * T[2, 1]) / count[side]
        align = min(align, -along if side == 0 else along)
        if seen[side] > 0.0:  # what was seen of the patch says where it is
            where[side] = where_seen[side] / seen[side]
        else:
            where[side] = where[side] / count[side]
    # what is measured fills the voxel that it is in, but pixels at the very edge of an object are lost
    width = max(high - low - 0.5, 0.5)
    out[WIDTH], out[NARROW] = width, max(narrow - 0.5, 0.0)
    out[TOUCH] = min(count[0], count[1]) / (_ACROSS * _ALONG)
    out[ALIGN], out[SURE] = align, min(sure[0] / count[0], sure[1] / count[1])
    out[UNSEEN] = unseen[0] / count[0] + unseen[1] / count[1]
    out[SLOPE] = math.hypot(where[0, 0] - where[1, 0], where[0, 1] - where[1, 1]) / max(width, 4.0)
    return True


@kernel
def _frame(d: Array, angle: float, T: Array) -> bool:
    """Write a rotation whose y is d and whose z is turned about d by an angle from straight down."""
    level = d[0] * d[0] + d[1] * d[1]
    if level < 0.36:
        return False
    size = math.sqrt(level)
    ax, ay, az = d[2] * d[0] / size, d[2] * d[1] / size, -size
    bx, by, bz = d[1] * az - d[2] * ay, d[2] * ax - d[0] * az, d[0] * ay - d[1] * ax
    c, s = math.cos(angle), math.sin(angle)
    zx, zy, zz = c * ax + s * bx, c * ay + s * by, c * az + s * bz
    T[0, 2], T[1, 2], T[2, 2] = zx, zy, zz
    T[0, 1], T[1, 1], T[2, 1] = d[0], d[1], d[2]
    T[0, 0], T[1, 0], T[2, 0] = d[1] * zz - d[2] * zy, d[2] * zx - d[0] * zz, d[0] * zy - d[1] * zx
    return True


@kernel
def search(
    cells: Bytes, obstacles: Bytes, normals: Floats, found_pairs: Array, hypotheses: Array, hand: Array, pads: Array,
    tips: Array, opening: float, finger_step: float, clearance: float, back: float, centre: Array, widest: float,
    least_cos: float, per_kind: int, enough: int, most: int, found: Array, why: Ints,
) -> int:  # fmt: skip
    """Try hand poses in their order until enough are good.

    Args:
        cells: (nx, ny, nz).
        obstacles: (nx, ny, nz) of the hand.
        normals: (nx, ny, nz, 3).
        found_pairs: (p, 8) of `pairs`.
        hypotheses: (h, 5) pair, turn about the closing axis (rad), contact along the pad (0 upper end, 1 tip), sign of
            the closing axis, kind.
        hand: (n, 3) points of the open hand.
        pads: (m, 4) by finger.
        tips: (m, c, 3) by finger.
        opening: Finger of the open hand.
        finger_step: Between rows of `pads` and `tips`.
        clearance: Clearance of the hand over the table.
        back: Length of the straight approach.
        centre: (3,) of mass.
        widest: Voxels.
        least_cos: Cosine of the friction cone.
        per_kind: Good poses of one kind.
        enough: Good poses.
        most: Poses that are tried.
        found: (enough, COLUMNS), filled.
        why: (8,) counts: tried, not enough of the object, table, hand hits, wide or something between, approach,
            contact, alignment.

    Returns:
        How many are good.
    """
    count, floor = 0, clearance - _ROUNDING
    T = np.eye(4)
    d, contact = np.empty(3), np.empty(COLUMNS)
    first, last = np.empty((_ACROSS, _ALONG)), np.empty((_ACROSS, _ALONG))
    good = np.zeros(int(hypotheses[:, 4].max()) + 1, np.int64)
    for h in range(hypotheses.shape[0]):
        if count == enough or why[0] == most:
            break
        p, kind = int(hypotheses[h, 0]), int(hypotheses[h, 4])
        if good[kind] >= per_kind:
            continue
        why[0] += 1
        pair, sign = found_pairs[p], hypotheses[h, 3]
        d[0], d[1], d[2] = sign * pair[3], sign * pair[4], sign * pair[5]
        ok, pad = True, pads[0]
        middle_x, middle_y, middle_z = pair[0], pair[1], pair[2]
        for turn in range(_ROUNDS):  # again with the closing axis across the sides that the pads meet
            row = min(round(0.5 * pair[6] / finger_step), pads.shape[0] - 1)
            pad = pads[row]
            if not _frame(d, sign * hypotheses[h, 1], T):
                ok = False
                break
            at = pad[2] + (pad[3] - pad[2]) * hypotheses[h, 2]
            T[0, 3], T[1, 3], T[2, 3] = middle_x - at * T[0, 2], middle_y - at * T[1, 2], middle_z - at * T[2, 2]
            if turn == 0:
                lowest = math.inf
                for n in range(tips.shape[1]):
                    z = T[2, 0] * tips[row, n, 0] + T[2, 1] * tips[row, n, 1] + T[2, 2] * tips[row, n, 2]
                    lowest = min(lowest, z)
                # lower than the table allows: the hand goes back along its approach, as far as the pad is long
                short = clearance - lowest - T[2, 3]
                if short > 0.0:
                    away = short / -T[2, 2]
                    if away > 0.5 * (pad[3] - pad[2]):
                        why[0] -= 1  # the same pose as with the contact nearer to the tip
                        why[2] += 1
                        ok = False
                        break
                    middle_x -= away * T[0, 2]
                    middle_y -= away * T[1, 2]
                    middle_z -= away * T[2, 2]
                    T[0, 3] -= away * T[0, 2]
                    T[1, 3] -= away * T[1, 2]
                    T[2, 3] -= away * T[2, 2]
                if _hits(obstacles, hand, T, T[0, 3], T[1, 3], T[2, 3], floor, 7) < 0:
                    why[3] += 1
                    ok = False
                    break
            if not _between(cells, T, pad, opening, first, last):
                why[4] += 1
                ok = False
                break
            low, high = math.inf, -math.inf
            for a in range(_ACROSS):
                for b in range(_ALONG):
                    if not math.isnan(first[a, b]):
                        low, high = min(low, first[a, b]), max(high, last[a, b])
            if high < low:
                why[6] += 1
                ok = False
                break
            slope = _turn(pad, first, last)
            if turn == _ROUNDS - 1 or abs(slope) < _STRAIGHT or abs(slope) > _CROOKED:
                ok = _touch(cells, normals, T, pad, first, last, contact)
                why[6] += not ok
                if ok and contact[WIDTH] + contact[UNSEEN] > widest:
                    why[4] += 1
                    ok = False
            # in the middle of what the pads meet
            off = 0.5 * (low + high)
            for axis in range(3):
                T[axis, 3] += off * T[axis, 1]
            middle_x += off * T[0, 1]
            middle_y += off * T[1, 1]
            middle_z += off * T[2, 1]
            if turn == _ROUNDS - 1 or abs(slope) < _STRAIGHT or abs(slope) > _CROOKED:
                break
            size = math.sqrt(1.0 + slope * slope)
            for axis in range(3):
                d[axis] = (T[axis, 1] - slope * T[axis, 0]) / size
            if pair[5] == 0.0:
                d[2] = 0.0
                size = math.hypot(d[0], d[1])
                d[0], d[1] = d[0] / size, d[1] / size
        if not ok:
            continue
        if contact[ALIGN] < least_cos:
            why[7] += 1
            continue
        blind = _hits(obstacles, hand, T, T[0, 3], T[1, 3], T[2, 3], floor, 1)
        if blind < 0:
            why[3] += 1
            continue
        steps = math.ceil(back / 4.0)
        for n in range(1, steps + 1):
            far = min(4.0 * n, back)
            bx, by, bz = T[0, 3] - far * T[0, 2], T[1, 3] - far * T[1, 2], T[2, 3] - far * T[2, 2]
            if _hits(obstacles, hand, T, bx, by, bz, floor, 2) < 0:
                ok = False
                break
        if not ok:
            why[5] += 1
            continue
        room = 0.0
        for side in range(2):
            for far in range(2):
                by_y = (3.0 if far else 1.5) * (1.0 if side else -1.0)
                free = _hits(
                    obstacles, hand, T, T[0, 3] + by_y * T[0, 1], T[1, 3] + by_y * T[1, 1], T[2, 3] + by_y * T[2, 1],
                    0.5 * clearance, 2,
                )  # fmt: skip
                if free < 0:
                    break
                room += 0.25
        out = found[count]
        for r in range(3):
            for c in range(4):
                out[4 * r + c] = T[r, c]
        z = 0.5 * (pad[2] + pad[3])
        rx, ry = centre[0] - T[0, 3] - z * T[0, 2], centre[1] - T[1, 3] - z * T[1, 2]
        level = max(math.hypot(T[0, 1], T[1, 1]), 1e-6)
        out[WIDTH : SLOPE + 1] = contact[WIDTH : SLOPE + 1]
        out[LEVER] = abs(rx * T[1, 1] - ry * T[0, 1]) / level
        out[ASIDE] = abs(rx * T[0, 1] + ry * T[1, 1]) / level
        out[TILT] = math.acos(min(1.0, -T[2, 2]))
        out[BLIND], out[ROOM], out[PAIR], out[OPENING] = blind / hand.shape[0], room, p, opening
        good[kind] += 1
        count += 1
    return count
