# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the fast collision layer: where bodies are, and which of their shapes are near to others or the map.

The answer "apart" is a proof while the answer "near" may be wrong; `fast_model` says what a scene is made of. m, rad,
base frame. The kernels release the GIL.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from openarm_common.types import Array
from openarm_motion.collision.fast_model import Model, Work, workspace
from openarm_motion.collision.map_kernels import map_distance, map_room, put_shape
from openarm_motion.collision.shape_kernels import BOX, separation

#: More room than this is looked for between the balls of clusters only, not between the shapes in them, m.
_CLOSE = 0.03


@njit(cache=True, nogil=True)
def place(q: Array, model: Model, work: Work) -> None:
    """Bring bodies and the centres of what moves with them to where they are in a state."""
    # fields are unpacked before loops here and below: each access costs a count of references
    frames, middles, parents, placements, axes = work.frames, work.middles, model.parents, model.placements, model.axes
    prismatic, clusters, centres = model.prismatic, model.clusters, model.centres
    for i in range(parents.shape[0]):
        p = parents[i]
        x, y, z = axes[i, 0], axes[i, 1], axes[i, 2]
        c, s = 1.0, 0.0
        if not prismatic[i]:
            c, s = math.cos(q[i]), math.sin(q[i])
        v = 1.0 - c
        t00, t01, t02 = c + x * x * v, x * y * v - z * s, x * z * v + y * s
        t10, t11, t12 = y * x * v + z * s, c + y * y * v, y * z * v - x * s
        t20, t21, t22 = z * x * v - y * s, z * y * v + x * s, c + z * z * v
        for r in range(3):
            p0, p1, p2 = frames[p, r, 0], frames[p, r, 1], frames[p, r, 2]
            a0 = p0 * placements[i, 0, 0] + p1 * placements[i, 1, 0] + p2 * placements[i, 2, 0]
            a1 = p0 * placements[i, 0, 1] + p1 * placements[i, 1, 1] + p2 * placements[i, 2, 1]
            a2 = p0 * placements[i, 0, 2] + p1 * placements[i, 1, 2] + p2 * placements[i, 2, 2]
            a3 = p0 * placements[i, 0, 3] + p1 * placements[i, 1, 3] + p2 * placements[i, 2, 3]
            frames[i + 1, r, 0] = a0 * t00 + a1 * t10 + a2 * t20
            frames[i + 1, r, 1] = a0 * t01 + a1 * t11 + a2 * t21
            frames[i + 1, r, 2] = a0 * t02 + a1 * t12 + a2 * t22
            along = (a0 * x + a1 * y + a2 * z) * q[i] if prismatic[i] else 0.0
            frames[i + 1, r, 3] = a3 + frames[p, r, 3] + along
    for k in range(model.runs.shape[0] - 1):
        b = clusters[k]
        x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
        for r in range(3):
            middles[k, r] = frames[b, r, 0] * x + frames[b, r, 1] * y + frames[b, r, 2] * z + frames[b, r, 3]
    work.done[model.kinds.shape[0]] += 1


@njit(cache=True, nogil=True)
def sift(share: float, model: Model, work: Work) -> int:
    """List the groups whose balls may come too near within `share` of their sways; returns how many. Maps are added."""
    near, middles, points, runs, reaches = work.near, work.middles, model.points, model.runs, model.spans
    groups, sways, lists = model.groups, work.sways, work.lists
    for c in range(runs.shape[0] - 1):
        x, y, z = middles[c, 0], middles[c, 1], middles[c, 2]
        for g in range(runs[c], runs[c + 1]):
            u, v, w = points[0, g] - x, points[1, g] - y, points[2, g] - z
            reach = reaches[g] + share * sways[g]
            near[g] = u * u + v * v + w * w <= reach * reach
    for g in range(runs[-1], groups.shape[0]):
        a, b = groups[g, 0], groups[g, 1]
        u, v, w = middles[b, 0] - middles[a, 0], middles[b, 1] - middles[a, 1], middles[b, 2] - middles[a, 2]
        reach = reaches[g] + share * sways[g]
        near[g] = u * u + v * v + w * w <= reach * reach
    count = 0
    for g in range(groups.shape[0]):
        if near[g]:
            lists[count] = g
            count += 1
    for g in range(groups.shape[0], sways.shape[0]):
        lists[count] = g
        count += 1
    return count


@njit(cache=True, nogil=True)
def look(start: int, count: int, end: int, share: float, model: Model, work: Work) -> int:
    """Look at listed groups (and bodies in the map) in the state that things were placed for.

    Args:
        start: Where the list begins.
        count: How many are in it.
        end: Where those are listed that may come too near within `share` of their sways; nothing is for -1.
        share: See `end`.
        model: The scene.
        work: Room.

    Returns:
        How many are listed at `end`; -1 when one is too near (or not proven to be far enough) in this state.
    """
    groups, middles, bounds, spans, kinds = model.groups, work.middles, model.bounds, model.spans, model.kinds
    world, sizes, radii, pairs, keeps = work.world, model.sizes, model.radii, model.pairs, model.keep
    bodies, poses, frames, done = model.bodies, model.poses, work.frames, work.done
    lists, sways, kept = work.lists, work.sways, 0
    balls, about, field, corner, edge = (
        model.sphere_groups,
        model.sphere_bounds,
        model.field,
        model.corner,
        model.edge,
    )
    for at in range(start, start + count):
        g = lists[at]
        enough = float(share * sways[g])
        if g >= groups.shape[0]:
            m = g - groups.shape[0]
            if map_distance(frames[balls[m, 0]], about[m], field, corner, edge) >= enough:
                continue
            least = map_room(m, enough, model, work)
        else:
            a, b, j = groups[g, 0], groups[g, 1], groups[g, 4]
            x, y, z = middles[a, 0] - middles[b, 0], middles[a, 1] - middles[b, 1], middles[a, 2] - middles[b, 2]
            apart, reach = x * x + y * y + z * z, spans[g]
            if j >= 0 and kinds[j] == BOX and apart <= (reach + enough) * (reach + enough):
                # a large one, say a table: its faces say more than the ball about it
                u = abs(x * world[j, 0, 0] + y * world[j, 1, 0] + z * world[j, 2, 0]) - sizes[j, 0]
                v = abs(x * world[j, 0, 1] + y * world[j, 1, 1] + z * world[j, 2, 1]) - sizes[j, 1]
                w = abs(x * world[j, 0, 2] + y * world[j, 1, 2] + z * world[j, 2, 2]) - sizes[j, 2]
                u, v, w = max(u, 0.0), max(v, 0.0), max(w, 0.0)
                apart, reach = u * u + v * v + w * w, reach - bounds[b]
            if apart > (reach + enough) * (reach + enough):
                continue
            close = enough < _CLOSE
            if apart > reach * reach and not close:
                # free here; to prove more by looking at each pair would cost more than it saves
                if end >= 0:
                    lists[end + kept] = g
                    kept += 1
                continue
            least = enough if close else 0.0
            for p in range(groups[g, 2], groups[g, 3]):
                i, j, keep = pairs[p, 0], pairs[p, 1], keeps[p]
                put_shape(i, bodies, poses, frames, done, world)
                put_shape(j, bodies, poses, frames, done, world)
                x, y, z = (
                    world[i, 0, 3] - world[j, 0, 3],
                    world[i, 1, 3] - world[j, 1, 3],
                    world[i, 2, 3] - world[j, 2, 3],
                )
                reach = max(radii[i] + radii[j] + keep + least, 0.0)
                if x * x + y * y + z * z > reach * reach:
                    continue
                least = min(least, separation(i, j, keep + least, kinds, sizes, world) - keep)
                if least < 0.0:
                    return -1
        if least < 0.0:
            return -1
        if end >= 0 and least < enough:
            lists[end + kept] = g
            kept += 1
    return kept


@njit(cache=True, nogil=True)
def near(q: Array, model: Model, work: Work) -> bool:
    """Whether in a state (n,) something is not proven to be as far from all else as it must be."""
    place(q, model, work)
    return look(0, sift(0.0, model, work), -1, 0.0, model, work) < 0


@njit(cache=True, nogil=True)
def states_free(states: Array, model: Model, out: NDArray[np.bool_]) -> None:
    """Whether each of the states (m, n) is proven free."""
    work = workspace(model)
    for k in range(states.shape[0]):
        out[k] = not near(states[k], model, work)
