# SPDX-License-Identifier: Apache-2.0
"""Level surfaces over a support that carry something: the top of a box, a shelf board, the bottom of a tray.

A surface is level where heights hardly change around a pixel. What rises over it within its outline stands on it, where
its surroundings in the image are that surface rather than something lower.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array, Bytes, Mask

#: Heights around a pixel, in a window of so many pixels, differ by no more than this where a surface is level, m; over
#: all of it by twice as much. Parts whose heights differ by less than half of it are one surface.
_WINDOW, _STEP = 5, 0.004
#: A surface has so many pixels, and its outline this area and width, m² and m; what stands on it as many pixels.
_PIXELS, _AREA, _WIDTH = 60, 0.0012, 0.03
#: Of what stands on a surface, this share is farther inside of its outline than the walls of a cup are, m.
_INNER, _WALL = 0.4, 0.004
#: Pixels around a thing that show what it stands on; the surface shows in this share as many as what is lower.
_RIM, _RATHER = 7, 0.5
#: A thing stands on the lowest surface that is under this share of its pixels.
_SHARE = 1.0 / 3.0


@dataclass(frozen=True, eq=False)
class Levels:
    """A support and the surfaces over it that carry something.

    Attributes:
        height: (n,) heights over the support, m; the first is the support itself.
        face: (h, w) number of the surface that a pixel shows; 0: none over the support.
        under: (h, w) number of the surface under what a pixel shows; 0: the support.
    """

    height: Array
    face: NDArray[np.uint8]
    under: NDArray[np.uint8]

    def over(self, heights: NDArray[np.float32]) -> Levels:
        """Return the same surfaces with their heights over another support, given those (h, w) of all pixels, m."""
        each = [float(np.nanmedian(heights[self.face == k])) for k in range(1, len(self.height))]
        return replace(self, height=np.array([0.0, *each]))

    def of(self, window: tuple[slice, slice], mask: Mask) -> int:
        """Return the number of the surface under a thing, given its pixels in a window of the image."""
        count = np.bincount(self.under[window][mask], minlength=len(self.height))
        shared = count >= min(_SHARE * count.sum(), float(count.max()))
        return int(np.argmin(np.where(shared, self.height, np.inf)))

    def ends(self) -> Bytes:
        """Return where a surface ends and what stands on it begins: (h, w), 1: to the right, 2: below, 3: both."""
        out = np.zeros(self.face.shape, np.uint8)
        for bit, near, far in ((1, np.s_[:, :-1], np.s_[:, 1:]), (2, np.s_[:-1], np.s_[1:])):
            (face, under), (other, over) = ((self.face[part], self.under[part]) for part in (near, far))
            out[near] |= np.uint8(bit) * (((face > 0) & (face == over)) | ((other > 0) & (other == under)))
        return out

    def carry(self, label: NDArray[np.integer], pairs: NDArray[np.integer]) -> Mask:
        """Return of which pairs (n, 2) of labels of an image (h, w) the first carries the second."""
        n, size = len(self.height), int(label.max()) + 1
        face, under = (
            np.bincount(label.ravel() * np.int64(n) + numbers.ravel(), minlength=size * n).reshape(size, n)
            for numbers in (self.face, self.under)
        )
        face[:, 0] = 0
        shown = np.where(face.any(axis=1), face.argmax(axis=1), -1)
        a, b = np.asarray(pairs).T
        return np.asarray(shown[a] == under.argmax(axis=1)[b])


def find_levels(points: Array | NDArray[np.float32], apart: Mask, least: float) -> Levels:
    """Find the surfaces that carry something.

    Args:
        points: (h, w, 3) axes of the support: z is the height over it, m; NaN where nothing was measured.
        apart: (h, w) pixels of nothing that stands or carries, such as those of the robot.
        least: Least height: what rises by less stands on nothing, m.
    """
    face, under = (np.zeros(points.shape[:2], np.uint8) for _ in range(2))
    heights = [0.0]
    z = np.where(np.isfinite(points[..., 2]) & ~apart, points[..., 2], -1.0).astype(np.float32)
    u, v, width, height = cv2.boundingRect((z > least).astype(np.uint8))
    window = slice(max(v - _RIM, 0), v + height + _RIM), slice(max(u - _RIM, 0), u + width + _RIM)
    z, flat, kernel = z[window], points[window][..., :2], np.ones((_WINDOW, _WINDOW), np.uint8)
    level = (z > least) & (cv2.dilate(z, kernel) - cv2.erode(z, kernel) <= _STEP)
    for around, parts in _surfaces(z, level) if width else ():
        own = (cv2.dilate(parts.astype(np.uint8), kernel) > 0) & (np.abs(z - around) <= _STEP)
        hull = cv2.convexHull((flat[own] * 1e3).astype(np.float32))
        if cv2.contourArea(hull) < 1e6 * _AREA or min(cv2.minAreaRect(hull)[1]) < 1e3 * _WIDTH:
            continue
        low, high = 1e-3 * hull[:, 0].min(axis=0), 1e-3 * hull[:, 0].max(axis=0)
        there, beyond = (z >= around - _STEP) & ((flat >= low) & (flat <= high)).all(axis=-1), np.full(z.shape, np.inf)
        higher = z > around + least
        if np.count_nonzero(higher & there) < _PIXELS:
            continue
        beyond[there] = outside(1e-3 * hull[:, 0].astype(np.float64), flat[there].astype(np.float64))
        things = [thing for thing in _parts(higher & (beyond <= 0.0)) if _stands(thing, z, around, least, beyond)]
        if things and len(heights) <= np.iinfo(np.uint8).max:
            face[window][(beyond <= 0.0) & ~higher] = len(heights)
            for thing in things:
                under[window][thing] = len(heights)
            heights.append(around)
    return Levels(np.array(heights), face, under)


def outside(hull: Array, points: Array) -> Array:
    """Return how far points (n, 2) are beyond a convex outline (k, 2), m (n,); negative inside."""
    along = np.roll(hull, -1, axis=0) - hull
    turn = 1.0 if float(np.sum(hull[:, 0] * along[:, 1] - hull[:, 1] * along[:, 0])) > 0.0 else -1.0
    side = along[:, 0] * (points[:, None, 1] - hull[:, 1]) - along[:, 1] * (points[:, None, 0] - hull[:, 0])
    return np.asarray((-turn * side / np.maximum(np.linalg.norm(along, axis=1), 1e-9)).max(axis=1))


def _parts(mask: Mask) -> list[Mask]:
    """Return the connected parts (h, w) of a mask that are large enough."""
    count, label, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    return [label == i for i in range(1, count) if stats[i, cv2.CC_STAT_AREA] >= _PIXELS]


def _surfaces(z: NDArray[np.float32], level: Mask) -> list[tuple[float, Mask]]:
    """Return heights and pixels (h, w) of level surfaces, the lowest first; what stands on one may divide it."""
    found: list[tuple[float, Mask]] = []
    parts = [(float(np.median(z[part])), part) for part in _parts(level)]
    for height, part in sorted(parts, key=lambda one: one[0]):
        low, high = np.percentile(z[part], (5.0, 95.0))
        if high - low > 2.0 * _STEP:
            continue
        if found and height - found[-1][0] < 0.5 * _STEP:
            both = found[-1][1] | part
            found[-1] = (float(np.median(z[both])), both)
        else:
            found.append((height, part))
    return found


def _stands(thing: Mask, z: NDArray[np.float32], height: float, least: float, beyond: Array) -> bool:
    """Return whether a thing (h, w) stands on the surface at a height rather than on something lower, or around it."""
    if np.mean(beyond[thing] <= -_WALL) < _INNER:
        return False
    rim = z[(cv2.dilate(thing.astype(np.uint8), np.ones((_RIM, _RIM), np.uint8)) > 0) & ~thing]
    lower = np.count_nonzero((rim < height - least) & (rim > -0.5))
    return bool(np.count_nonzero(np.abs(rim - height) <= _STEP) >= max(_RATHER * lower, 1.0))
