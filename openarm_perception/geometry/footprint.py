# SPDX-License-Identifier: Apache-2.0
"""Rectangles and circles through the outline of an object seen from above; metres in the horizontal plane.

The outline is a set of points on the edges, in no order, possibly with gaps where something hid the object.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_common.walls import wall_yaw

Kind = Literal["rectangle", "circle", "bound"]

#: Cells that the walls of a cloud are found in are no smaller, m.
_CELL = 0.0025
#: Nor than so many pixels, as what is seen at a slant has its points farther apart.
_APART = 1.5


@dataclass(frozen=True)
class Footprint:
    """What an object covers, seen from above.

    Attributes:
        kind: `rectangle` or `circle`, fitted; `bound`: the rectangle around what was seen.
        centre: (2,) m.
        yaw: Direction of the smaller extent, rad in (-pi/2, pi/2]; 0 for a circle.
        size: (smaller, larger) extent, m; the diameter twice for a circle.
        rms: Root mean square of the distances from the outline to the fitted shape, m.
        centre_std: Along the smaller and the larger extent, m.
        yaw_std: rad; that of any direction for a circle.
    """

    kind: Kind
    centre: Array
    yaw: float
    size: tuple[float, float]
    rms: float
    centre_std: tuple[float, float]
    yaw_std: float


#: Standard deviation of an angle that can be anything within half a turn.
ANY_YAW_STD = math.pi / math.sqrt(12.0)


def fit(outline: Array, spacing: float, *, whole: bool = False) -> Footprint:
    """Return the rectangle or the circle through an outline, whichever lies nearer to it.

    Args:
        outline: (n, 2) points on the edges, m.
        spacing: Distance of neighbouring points, m (the size of a pixel).
        whole: Whether nothing hides a part of it: sides of few pixels are known by as few points.

    Raises:
        OpenArmError: NOTHING_DETECTED, when there are too few points, or too much of the outline is hidden.
    """
    if len(outline) < 12:
        raise OpenArmError(
            Code.NOTHING_DETECTED, f"outline has {len(outline)} points, expected at least 12; the object is too small"
        )
    circle, to_circle = _fit_circle(outline, spacing)
    rectangle, to_rectangle = _fit_rectangle(outline, spacing, whole)
    best = circle if to_circle < to_rectangle else rectangle
    if isinstance(best, str):
        raise OpenArmError(Code.NOTHING_DETECTED, best)
    return best


def bound(points: Array, pixel: float, missing: float) -> Footprint:
    """Return the rectangle around points (n, 2), m, along most of its walls: for what is neither rectangle nor circle.

    Args:
        points: Seen ones, m.
        pixel: Distance of neighbouring points across the view, m.
        missing: Length by which the rectangle is larger, m: half a pixel is missing on every side that faces away.
    """
    yaw = wall_yaw(points, max(_APART * pixel, _CELL))
    local = points @ _rotation(yaw)
    low, high = local.min(axis=0), local.max(axis=0)
    centre = _rotation(yaw) @ (0.5 * (low + high))
    width, length = high - low
    if width > length:
        width, length, yaw = length, width, yaw + math.pi / 2.0
    smaller, larger = float(width) + missing, float(length) + missing
    std = (0.1 * smaller, 0.1 * larger)
    return Footprint("bound", centre, _half_turn(yaw), (smaller, larger), 0.0, std, math.radians(10.0))


def _half_turn(yaw: float) -> float:
    """Return the direction in (-pi/2, pi/2]."""
    return math.pi / 2.0 - (math.pi / 2.0 - yaw) % math.pi


def _rms(residual: Array) -> float:
    return float(np.sqrt(np.mean(residual**2)))


def _fit_circle(outline: Array, spacing: float) -> tuple[Footprint | str, float]:
    # algebraic start (x² + y² = 2 a x + 2 b y + c), then Gauss-Newton on distances: the start alone shrinks on arcs
    shift = outline.mean(axis=0)
    p = outline - shift
    A = np.column_stack([2.0 * p, np.ones(len(p))])
    a, b, c = np.linalg.lstsq(A, (p**2).sum(axis=1), rcond=None)[0]
    centre, radius = np.array([a, b]), math.sqrt(max(c + a * a + b * b, 1e-12))
    for _ in range(5):
        offset = p - centre
        distance = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
        J = np.column_stack([offset / distance[:, None], np.ones(len(p))])
        step = np.linalg.lstsq(J, distance - radius, rcond=None)[0]
        centre, radius = centre + step[:2], radius + step[2]
    offset = p - centre
    residual = np.linalg.norm(offset, axis=1) - radius
    bins = np.unique(np.floor((np.arctan2(offset[:, 1], offset[:, 0]) + math.pi) / (2.0 * math.pi) * 16.0))
    rms = _rms(residual)
    if len(bins) < 10:
        return f"only {len(bins)} of 16 parts of the round outline are in view; something hides the object", rms
    std = max(rms, 0.3 * spacing) / math.sqrt(len(p) / 2.0)
    size = (2.0 * radius, 2.0 * radius)
    return Footprint("circle", shift + centre, 0.0, size, rms, (std, std), ANY_YAW_STD), rms


def _fit_rectangle(outline: Array, spacing: float, whole: bool) -> tuple[Footprint | str, float]:
    (cx, cy), (width, height), angle_deg = cv2.minAreaRect((outline * 1e3).astype(np.float32))
    centre = np.array([cx, cy]) * 1e-3
    half = np.array([width, height]) * 0.5e-3
    yaw = math.radians(angle_deg)
    sides: list[Array] = []
    for step in range(6):
        local = _to_local(outline, centre, yaw)
        # one stray point stretches the first rectangle, so the first assignment is generous and the later ones are not
        sides = _assign(local, half, spacing, 0.3 * float(half.min()) * 0.5**step, whole)
        for index, side in enumerate(sides):
            # the direction comes from all sides, so a short piece is enough to locate its side
            if len(side) < (np.clip(half[1 - index // 2] / spacing, 3, 6) if whole else 6):
                text = f"an edge across the {('first', 'second')[index // 2]} axis of the outline is in view at"
                text += f" {len(side)} points only; something hides the object"
                return text, _rectangle_rms(local, half)
        # one direction for all four sides in closed form: turn two of them by a right angle and add the scatter
        scatter = np.zeros((2, 2))
        for index, side in enumerate(sides):
            q = side - side.mean(axis=0)
            q = q if index < 2 else np.column_stack([q[:, 1], -q[:, 0]])
            scatter += q.T @ q
        normal = np.linalg.eigh(scatter)[1][:, 0]
        turn = math.atan2(normal[1], normal[0])
        turn = (turn + math.pi / 2.0) % math.pi - math.pi / 2.0
        R = _rotation(turn)
        offsets = [float((side @ R)[:, index // 2].mean()) for index, side in enumerate(sides)]
        middle = np.array([(offsets[0] + offsets[1]) / 2.0, (offsets[2] + offsets[3]) / 2.0])
        half = np.array([(offsets[1] - offsets[0]) / 2.0, (offsets[3] - offsets[2]) / 2.0])
        centre = centre + _rotation(yaw) @ R @ middle
        yaw += turn
    rms = _rectangle_rms(_to_local(outline, centre, yaw), half)
    sigma = max(rms, 0.3 * spacing)
    stds = [sigma * math.sqrt(1.0 / len(sides[2 * i]) + 1.0 / len(sides[2 * i + 1])) / 2.0 for i in (0, 1)]
    lever = sum(float(((s[:, 1 - i // 2] - s[:, 1 - i // 2].mean()) ** 2).sum()) for i, s in enumerate(sides))
    if half[0] > half[1]:
        half, stds, yaw = half[::-1], stds[::-1], yaw + math.pi / 2.0
    size = (2.0 * float(half[0]), 2.0 * float(half[1]))
    return Footprint("rectangle", centre, _half_turn(yaw), size, rms, (stds[0], stds[1]), sigma / math.sqrt(lever)), rms


def _rotation(yaw: float) -> Array:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s], [s, c]])


def _to_local(outline: Array, centre: Array, yaw: float) -> Array:
    return (outline - centre) @ _rotation(yaw)


def _assign(local: Array, half: Array, spacing: float, slack: float, whole: bool) -> list[Array]:
    """Points of the sides -x, +x, -y, +y; without those near a corner, whose side is open, and without strays."""
    x, y = local.T
    distance = np.abs(np.stack([x + half[0], x - half[0], y + half[1], y - half[1]], axis=1))
    nearest = distance.argmin(axis=1)
    residual = distance.min(axis=1)
    limit = max(2.0 * spacing, 3.0 * float(np.median(residual)), slack)
    sides: list[Array] = []
    for index in range(4):
        axis = index // 2
        along = np.abs(local[:, 1 - axis])
        corner = min(1.5 * spacing, 0.3 * float(half[1 - axis])) if whole else 1.5 * spacing
        keep = (nearest == index) & (residual <= limit) & (along < half[1 - axis] - corner)
        sides.append(local[keep])
    return sides


def _rectangle_rms(local: Array, half: Array) -> float:
    q = np.abs(local) - half
    outside = np.linalg.norm(np.maximum(q, 0.0), axis=1)
    inside = np.minimum(q.max(axis=1), 0.0)
    return _rms(outside + inside)
