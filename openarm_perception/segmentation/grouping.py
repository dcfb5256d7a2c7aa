# SPDX-License-Identifier: Apache-2.0
"""Patches of surface to things: patches that meet convexly belong together, those that meet in a notch do not.

Whether two patches meet convexly is seen from their planes (Stein, Schoeler, Papon, Wörgötter, CVPR 2014, Object
partitioning using local convexity). Each pixel along the border between two patches votes for it or against it, and
groups are joined, the surest first, while the mean vote along their common border is for it (agglomeration of signed
graphs with average linkage: Bailoni et al., CVPR 2022, GASP). So a gap in a notch joins nothing.
"""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from openarm_common.types import Array
from openarm_perception.segmentation.kernels import Labels

#: A notch as sharp as this is the border of a thing; LCCP takes 10 deg.
NOTCH = math.radians(10.0)
#: And a step as high as this, or twice the noise: the least height of a thing, m.
STEP = 0.004
#: A few votes for a border make it less sure than many do, by so many that say nothing.
_DOUBT = 5.0
#: Pixels of a patch from which its plane is known.
_FEW = 8
#: Patches of one surface are within this of each other, rad; those of two faces of a box are not.
SMOOTH = math.radians(35.0)
#: How often things are put together with planes that reach over neighbouring patches.
_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Patches:
    """Planes of patches; row 0 is none.

    Attributes:
        count: (n,) pixels.
        centre: (n, 3) m.
        normal: (n, 3) unit vectors towards the camera; NaN of patches with too few pixels.
        std: (n,) standard deviation of the direction of the normal, rad.
    """

    count: Array
    centre: Array
    normal: Array
    std: Array


def planes(moments: Array) -> Patches:
    """Fit planes to patches, given sums (n, 10) as of `patch_moments`."""
    count = moments[:, 0]
    share = 1.0 / np.maximum(count, 1.0)
    centre = moments[:, 1:4] * share[:, None]
    xx, xy, xz, yy, yz, zz = (moments[:, 4:] * share[:, None]).T
    second = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=-1).reshape(-1, 3, 3)
    spread, axes = np.linalg.eigh(second - centre[:, :, None] * centre[:, None, :])
    normal = axes[:, :, 0]
    normal = np.where(np.sum(normal * centre, axis=1)[:, None] > 0.0, -normal, normal)
    normal[count < _FEW] = np.nan
    # across its narrow side a plane is known worst
    std = np.sqrt(np.maximum(spread[:, 0], 0.0) / np.maximum(spread[:, 1] * np.maximum(count, 1.0), 1e-18))
    return Patches(count, centre, normal, np.minimum(std, 1.0))


def notches(patches: Patches, pairs: Labels) -> Array:
    """Return how sharp the notches (n,) between pairs (n, 2) of patches are, rad; negative where they meet convexly.

    NaN where the plane of one is not known.
    """
    a, b = pairs.T
    along = patches.centre[a] - patches.centre[b]
    along /= np.maximum(np.linalg.norm(along, axis=1), 1e-9)[:, None]
    turn = np.sum((patches.normal[b] - patches.normal[a]) * along, axis=1)
    angle = np.arccos(np.clip(np.sum(patches.normal[a] * patches.normal[b], axis=1), -1.0, 1.0))
    return np.where(turn >= 0.0, angle, -angle)


def beyond_bend(notch: Array, apart: Array, pairs: Labels, count: int) -> Array:
    """Return how much sharper (n,) each notch is than those around it, rad: the inside of a bowl is hollow everywhere.

    Args:
        notch: (n,) as of `notches`.
        apart: (n,) how far apart the planes were fitted, m; a hollow surface turns in proportion to it.
        pairs: (n, 2) of patches.
        count: Number of patches.
    """
    known = np.isfinite(notch)
    of = np.concatenate([pairs[known, 0], pairs[known, 1]])
    rate = np.tile(notch[known] / apart[known], 2)
    order = np.lexsort((rate, of))
    of, rate = of[order], rate[order]
    first = np.searchsorted(of, np.arange(count + 1))
    size = np.diff(first)
    # the lower median: with few neighbours rather none of their notches is taken off
    middle = np.clip(first[:-1] + (size - 1) // 2, 0, max(len(rate) - 1, 0))
    bend = np.where(size > 2, np.maximum(rate[middle], 0.0), 0.0) if len(rate) else np.zeros(count)
    return notch - np.minimum(bend[pairs[:, 0]], bend[pairs[:, 1]]) * apart


def steps(patches: Patches, own: Array, pairs: Labels) -> Array:
    """Return how far (n,) the planes of pairs of patches lie one above the other, m; 0 where they are no parallels.

    What a surface bends by on the way from one centre to the other cancels out.

    Args:
        patches: Their planes.
        own: (m, 3) centres of the patches themselves, m.
        pairs: (n, 2).
    """
    a, b = pairs.T
    step = np.abs(0.5 * np.sum((patches.normal[a] + patches.normal[b]) * (own[b] - own[a]), axis=1))
    parallel = np.sum(patches.normal[a] * patches.normal[b], axis=1) > math.cos(SMOOTH)
    return np.where(parallel, step, 0.0)


def singular(patches: Patches, own: Array, pairs: Labels) -> Array:
    """Return which pairs (n,) of patches lie along the line where their planes meet, 0 or 1.

    They touch at a corner only, and whether they meet convexly is not seen there (the sanity criterion of LCCP).

    Args:
        patches: Their planes.
        own: (m, 3) centres of the patches themselves, m.
        pairs: (n, 2).
    """
    a, b = pairs.T
    crease = np.cross(patches.normal[a], patches.normal[b])
    sine = np.linalg.norm(crease, axis=1)
    along = own[a] - own[b]
    length = np.linalg.norm(along, axis=1) * sine
    cosine = np.abs(np.sum(crease * along, axis=1)) / np.maximum(length, 1e-12)
    between = np.degrees(np.arccos(np.clip(np.sum(patches.normal[a] * patches.normal[b], axis=1), -1.0, 1.0)))
    least = 60.0 / (1.0 + np.exp(-0.25 * (between - 25.0)))
    return (np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))) < least).astype(np.float64)


def votes(
    patches: Patches, own: Array, pairs: Labels, length: Array, broken: Array, noise: float
) -> tuple[Array, Array]:
    """Return the sums (n,) of the votes along the borders of pairs of patches, and how many votes they count as.

    Args:
        patches: Their planes, which may reach beyond them.
        own: (m, 3) centres of the patches themselves, m.
        pairs: (n, 2) of patches.
        length: (n,) of their borders, pixels.
        broken: (n,) of that, where depth breaks.
        noise: Noise of a depth at 1 m, m.
    """
    a, b = pairs.T
    apart = np.maximum(np.linalg.norm(patches.centre[a] - patches.centre[b], axis=1), 1e-6)
    notch = beyond_bend(notches(replace(patches, centre=own), pairs), apart, pairs, len(own))
    std = np.hypot(patches.std[a], patches.std[b])
    tolerance = np.hypot(NOTCH, 2.0 * std)
    vote = np.where(np.isfinite(notch), np.clip((tolerance - notch) / tolerance, -1.0, 1.0), 0.1)
    allowed = np.hypot(STEP, 2.0 * noise * np.maximum(own[a, 2], own[b, 2]) ** 2)
    vote = np.minimum(vote, np.clip((allowed - steps(patches, own, pairs)) / allowed, -1.0, 1.0))
    # what is known badly says little: a patch across an edge
    certain = NOTCH**2 / (NOTCH**2 + 4.0 * std**2) * (1.0 - 0.9 * singular(patches, own, pairs))
    return (vote * (length - broken) - broken) * certain, length * certain


def partition(moments: Array, border: Labels, noise: float) -> tuple[NDArray[np.int32], Patches]:
    """Join patches to things; again with planes that reach as far as the patches around, of the same thing.

    Args:
        moments: (count, 10) as of `patch_moments`.
        border: (k, 3) as of `borders`.
        noise: Noise of a depth at 1 m, m.

    Returns:
        (count,) group of each patch, the number of one of its patches; the planes that were found last.
    """
    count = len(moments)
    pairs, index = np.unique(border[:, :2], axis=0, return_inverse=True)
    length = np.bincount(index.ravel(), minlength=len(pairs)).astype(np.float64)
    broken = np.bincount(index.ravel(), weights=border[:, 2] > 0, minlength=len(pairs)).astype(np.float64)
    patches = planes(moments)
    own = patches.centre
    root = group(count, pairs, *votes(patches, own, pairs, length, broken, noise))
    for _ in range(_ROUNDS):
        a, b = pairs.T
        smooth = np.sum(patches.normal[a] * patches.normal[b], axis=1) > math.cos(SMOOTH)
        smooth &= (root[a] == root[b]) & (broken < 0.5 * length)
        wide = moments.copy()
        np.add.at(wide, a[smooth], moments[b[smooth]])
        np.add.at(wide, b[smooth], moments[a[smooth]])
        patches = planes(wide)
        root = group(count, pairs, *votes(patches, own, pairs, length, broken, noise))
    return root, patches


def group(count: int, pairs: Labels, weight: Array, length: Array) -> NDArray[np.int32]:
    """Join patches while the mean vote along their common border is for it, the surest first.

    Args:
        count: Number of patches, with row 0.
        pairs: (n, 2).
        weight: (n,) sums of votes.
        length: (n,) of votes.

    Returns:
        (count,) group of each patch: the number of one of its patches.
    """
    around: list[dict[int, tuple[float, float]]] = [{} for _ in range(count)]
    waiting: list[tuple[float, int, int]] = []
    for (a, b), w, n in zip(pairs.tolist(), weight.tolist(), length.tolist(), strict=True):
        around[a][b] = around[b][a] = (w, n)
        if w > 0.0:
            waiting.append((-w / (n + _DOUBT), a, b))
    heapq.heapify(waiting)
    parent = list(range(count))
    while waiting:
        key, a, b = heapq.heappop(waiting)
        found = around[a].get(b) if parent[a] == a and parent[b] == b else None
        if found is None or -found[0] / (found[1] + _DOUBT) != key:
            continue  # joined since, or its border has changed
        if len(around[a]) < len(around[b]):
            a, b = b, a
        parent[b] = a
        del around[a][b]
        for other, (w, n) in around[b].items():
            if other == a:
                continue
            del around[other][b]
            before = around[a].get(other, (0.0, 0.0))
            joined = (before[0] + w, before[1] + n)
            around[a][other] = around[other][a] = joined
            if joined[0] > 0.0:
                heapq.heappush(waiting, (-joined[0] / (joined[1] + _DOUBT), min(a, other), max(a, other)))
        around[b] = {}
    root = np.arange(count, dtype=np.int32)
    for i in range(count):
        at = i
        while parent[at] != at:
            at = parent[at]
        root[i] = at
    return root
