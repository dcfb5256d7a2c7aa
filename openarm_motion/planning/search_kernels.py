# SPDX-License-Identifier: Apache-2.0
"""Numba kernels that search and shorten joint paths on the fast collision layer; they release the GIL. rad, s."""

from __future__ import annotations

import math

import numpy as np

from openarm_common.kernels import bare_kernel, inner_kernel, kernel
from openarm_common.types import Array, Ints
from openarm_motion.collision.clearance_kernels import Model, Workspace, near
from openarm_motion.collision.line_kernels import between_free, line_free

#: Two configurations nearer than this are one, rad.
_SAME = 1e-6
#: Attempts in a row without success after which a path counts as short.
_IDLE = 20
#: Share of samples that are uniform, and how far away others are drawn, rad.
_UNIFORM, _FAR = 0.05, 6.0
#: One sample in so many is for the larger tree.
_TURNS = 20


@inner_kernel
def _copy(q: Array, out: Array) -> None:
    for i in range(q.shape[0]):
        out[i] = q[i]


@inner_kernel
def _nearest(tree: Array, count: int, q: Array) -> tuple[int, float]:
    best, at = np.inf, 0
    for k in range(count):
        d = 0.0
        for i in range(q.shape[0]):
            e = tree[k, i] - q[i]
            d += e * e
        if d < best:
            best, at = d, k
    return at, math.sqrt(best)


@inner_kernel
def _draw(tree: Array, count: int, bounds: Array, sample: Array) -> None:
    """Draw a sample: mostly far away from a configuration of the tree in a random direction, cut off at the bounds.

    Uniform samples pull each configuration towards the middle of the bounds, and those in a narrow place hardly ever
    along it.
    """
    n, square = sample.shape[0], 0.0
    if np.random.random() < _UNIFORM:
        for i in range(n):
            sample[i] = bounds[0, i] + (bounds[1, i] - bounds[0, i]) * np.random.random()
        return
    k = int(np.random.random() * count)
    for i in range(n):
        sample[i] = np.random.normal()
        square += sample[i] * sample[i]
    far = _FAR / math.sqrt(square)
    for i in range(n):
        sample[i] = min(max(tree[k, i] + far * sample[i], bounds[0, i]), bounds[1, i])


@kernel
def grow(
    trees: Array,
    parents: Ints,
    counts: Ints,
    bounds: Array,
    reach: float,
    resolution: Array,
    levers: Array,
    model: Model,
    work: Workspace,
    iterations: int,
    seed: int,
) -> tuple[int, int, int]:
    """RRT-Connect: grow two trees for a while; call again with another seed to go on.

    Kuffner and LaValle, "RRT-Connect: an efficient approach to single-query path planning", 2000, with the balanced
    trees of their "An efficient approach to path planning using balanced bidirectional RRT search", 2005.

    Args:
        trees: (2, m, n) configurations of the tree from the start and of the one from the goals.
        parents: (2, m), -1 for roots.
        counts: (2,) configurations in each.
        bounds: (2, n) lower and upper.
        reach: Longest edge, rad.
        resolution: (2,) step (rad) and travel (m) between two checks.
        levers: (n,) m.
        model: The scene.
        work: Room.
        iterations: Number of samples.
        seed: Seed of the samples.

    Returns:
        The configuration of each tree at which they meet, -1 when they don't; and how many lines were checked.
    """
    np.random.seed(seed)
    n, room, edges = trees.shape[2], trees.shape[1], 0
    step, travel = resolution[0], resolution[1]
    sample, new = np.empty(n), np.empty(n)
    for iteration in range(iterations):
        # the smaller tree is the one that is stuck; the other has a turn in case it never comes out
        a = int(counts[0] > counts[1]) if iteration % _TURNS else int(counts[0] <= counts[1])
        b = 1 - a
        if counts[0] >= room - 1 or counts[1] >= room - 1:
            break
        _draw(trees[a], counts[a], bounds, sample)
        at, d = _nearest(trees[a], counts[a], sample)
        if d < _SAME:
            continue
        u = min(1.0, reach / d)
        for i in range(n):
            new[i] = trees[a, at, i] + u * (sample[i] - trees[a, at, i])
        edges += 1
        if near(new, model, work) or not between_free(trees[a, at], new, step, travel, levers, model, work):
            continue
        end = counts[a]
        _copy(new, trees[a, end])
        parents[a, end] = at
        counts[a] += 1
        at, d = _nearest(trees[b], counts[b], new)
        while counts[b] < room:
            if d < _SAME:
                return (end, at, edges) if a == 0 else (at, end, edges)
            u = min(1.0, reach / d)
            for i in range(n):
                sample[i] = trees[b, at, i] + u * (new[i] - trees[b, at, i]) if u < 1.0 else new[i]
            edges += 1
            # the last one is the tip of the other tree: known to be free
            if u < 1.0 and near(sample, model, work):
                break
            if not between_free(trees[b, at], sample, step, travel, levers, model, work):
                break
            _copy(sample, trees[b, counts[b]])
            parents[b, counts[b]] = at
            at = counts[b]
            counts[b] += 1
            d = max(0.0, d - reach)
    return -1, -1, edges


@inner_kernel
def rest_to_rest(velocity: float, acceleration: float, jerk: float) -> float:
    """Shortest time over a length of one, from rest to rest, within the limits (per that length)."""
    # each half: the acceleration rises, stays, falls; the velocity stays in between
    ramp = acceleration / jerk
    half = math.sqrt(velocity / jerk) * 2.0 if velocity < acceleration * ramp else velocity / acceleration + ramp
    if velocity * half <= 1.0:
        return 1.0 / velocity + half
    if 2.0 * acceleration * ramp * ramp <= 1.0:
        return ramp + math.sqrt(ramp * ramp + 4.0 / acceleration)
    return 4.0 * (0.5 / jerk) ** (1.0 / 3.0)


@bare_kernel
def duration(a: Array, b: Array, limits: Array) -> float:
    """Time of a straight joint segment from rest to rest, s; `limits` (3, n) are velocity, acceleration, jerk."""
    velocity, acceleration, jerk = np.inf, np.inf, np.inf
    for i in range(a.shape[0]):
        size = max(abs(b[i] - a[i]), 1e-12)
        velocity = min(velocity, limits[0, i] / size)
        acceleration = min(acceleration, limits[1, i] / size)
        jerk = min(jerk, limits[2, i] / size)
    return rest_to_rest(velocity, acceleration, jerk)


@kernel
def _skip(points: Array, count: int, resolution: Array, levers: Array, model: Model, work: Workspace) -> int:
    """Go from each way point to the furthest one that a free line reaches; returns how many are left."""
    i, kept = 0, 1
    while i < count - 1:
        j = count - 1
        while j > i + 1 and not line_free(points[i], points[j], resolution[0], resolution[1], levers, model, work):
            j -= 1
        _copy(points[j], points[kept])
        kept += 1
        i = j
    return kept


@kernel
def shorten(
    points: Array,
    count: int,
    attempts: int,
    seed: int,
    limits: Array,
    resolution: Array,
    levers: Array,
    model: Model,
    work: Workspace,
) -> int:
    """Make a path faster in place: leave way points out, cut corners, pull way points towards their neighbours.

    Args:
        points: (m, n) with room for a few more than `count`.
        count: Way points.
        attempts: Random attempts.
        seed: Seed of these.
        limits: (3, n) velocity, acceleration and jerk: a corner costs a stop.
        resolution: (2,) step (rad) and travel (m) between two checks.
        levers: (n,) m.
        model: The scene.
        work: Room.

    Returns:
        How many way points are left.
    """
    np.random.seed(seed)
    n = points.shape[1]
    count = _skip(points, count, resolution, levers, model, work)
    fresh, idle = np.empty((4, n)), 0
    for _ in range(attempts):
        if count < 3 or idle > _IDLE:
            break
        idle += 1
        if np.random.random() < 0.5:
            at = 1 + int(np.random.random() * (count - 2))
            first, last, size = at - 1, at + 1, 3
            u, along, square = np.random.random(), 0.0, 0.0
            for i in range(n):
                d = points[last, i] - points[first, i]
                along += (points[at, i] - points[first, i]) * d
                square += d * d
            w = min(1.0, max(0.0, along / max(square, 1e-12)))
            for i in range(n):
                middle = points[first, i] + w * (points[last, i] - points[first, i])
                fresh[0, i], fresh[2, i] = points[first, i], points[last, i]
                fresh[1, i] = points[at, i] + u * (middle - points[at, i])
        else:
            one, two = int(np.random.random() * (count - 1)), int(np.random.random() * (count - 1))
            if one == two:
                continue
            first, last, size = min(one, two), max(one, two) + 1, 4
            u, w = np.random.random(), np.random.random()
            for i in range(n):
                fresh[0, i], fresh[3, i] = points[first, i], points[last, i]
                fresh[1, i] = points[first, i] + u * (points[first + 1, i] - points[first, i])
                fresh[2, i] = points[last - 1, i] + w * (points[last, i] - points[last - 1, i])
        before, after = 0.0, 0.0
        for k in range(first, last):
            before += duration(points[k], points[k + 1], limits)
        for k in range(size - 1):
            after += duration(fresh[k], fresh[k + 1], limits)
        longer = size - (last - first + 1)
        if after >= 0.99 * before or count + longer > points.shape[0]:
            continue
        free = True
        # of a cut corner, the first and the last piece lie on lines that are known
        for k in range(1 if size == 4 else 0, 2):
            free = free and line_free(fresh[k], fresh[k + 1], resolution[0], resolution[1], levers, model, work)
        if not free:
            continue
        if longer > 0:
            for k in range(count - 1, last, -1):
                _copy(points[k], points[k + longer])
        elif longer < 0:
            for k in range(last + 1, count):
                _copy(points[k], points[k + longer])
        for k in range(size):
            _copy(fresh[k], points[first + k])
        count += longer
        idle = 0
    return _skip(points, count, resolution, levers, model, work)
