# SPDX-License-Identifier: Apache-2.0
"""Numba kernels of the fast collision layer: where bodies are, and which of their shapes are near to others or the map.

The answer "apart" is a proof while the answer "near" may be wrong. Shapes are boxes, cylinders, spheres and convex
hulls on bodies. Body 0 is the base, bodies 1..n follow the joints. Shapes of one body are a cluster with a ball about
it, and a hull or box, which is asked first; two clusters whose shapes are to be checked are a group. m,
rad, base frame. The kernels release the GIL.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from openarm_common.collision.hull_kernels import hull_separation
from openarm_common.collision.shape_kernels import BOX, HULL, put_shape, separation
from openarm_common.kernels import bare_kernel, inner_kernel, kernel
from openarm_common.robot.tree_kernels import place_bodies, unplaced
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
        kinds: (s,) BOX, CYLINDER, SPHERE or HULL.
        sizes: (s, 3) half edges; radius, half length; radius; of a hull, half edges of the box about it.
        corners: (v, 3) of hulls, in the frames of their shapes.
        tips: (s,) some corner of each hull, 0 of other shapes.
        firsts: (v + 1,) where the neighbours of each corner begin.
        rings: corners that edges lead to, corner by corner.
        radii: (s,) of the ball about the shape's centre that holds it.
        bodies: (s,) body of each shape.
        poses: (s, 3, 4) of each shape in its body.
        clusters: (c,) body of each cluster; those that move come first.
        centres: (c, 3) of the ball about a cluster, in its body.
        bounds: (c,) radius of that ball.
        hulls: (c,) a shape that holds all of the cluster.
        runs: (moving clusters + 1,) where the groups of each moving cluster with clusters at rest begin.
        groups: (g, 6) clusters a (moving) and b, the first and last + 1 of their pairs, b's shape if it is one
            at rest, else -1, and the last body that carries both; groups of two moving clusters come last.
        points: (3, g) centre of cluster b where it is at rest.
        reaches: (g,) greatest distance that a pair of the group must keep.
        spans: (g,) the same with the radii of both balls.
        swings: (moving clusters + m, n) how far, at most, a point of a cluster (of a body's spheres) moves when a joint
            turns by 1 rad, m.
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
    corners: Array
    tips: Ints
    firsts: Ints
    rings: Ints
    radii: Array
    bodies: Ints
    poses: Array
    clusters: Ints
    centres: Array
    bounds: Array
    hulls: Ints
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


class Workspace(NamedTuple):
    """Room for one thread.

    Attributes:
        frames: (n + 1, 3, 4) poses of bodies.
        world: (s, 3, 4) poses of shapes.
        done: (s + 1,) the number of the state that each shape was last placed for; the last one is that number.
        middles: (c, 3) centres of clusters.
        near: (g,) flags.
        sways: (moving clusters + m, n + 1) how far, at most, points of a cluster (of a body's spheres) are from where
            they are now in any state of an interval of a line, as seen from a body that carries it, m.
        still: The same for a state alone: zeros.
        levers: (n, 6) see `place_bodies`.
        lists: Numbers of groups.
        spans: (k, 4) intervals of a line: first and last point, where the list of its groups begins, its length.
        q: (n,) a state.
        past: (p + g + 1, 3) axes of pairs, groups and a cell of the map, see `hull_separation`.
        tips: (p + g + 1, 2) corners of the same, see there.
        simplex: (14, 3) see there; the last rows are ranges of cells.
    """

    frames: Array
    world: Array
    done: Ints
    middles: Array
    near: NDArray[np.uint8]
    sways: Array
    still: Array
    levers: Array
    lists: Ints
    spans: Ints
    q: Array
    past: Array
    tips: Ints
    simplex: Array


@kernel
def workspace(model: Model) -> Workspace:
    """Room for one thread."""
    n, s, c, g = model.parents.shape[0], model.kinds.shape[0], model.clusters.shape[0], model.groups.shape[0]
    world, middles = np.zeros((s, 3, 4)), np.zeros((c, 3))
    work = Workspace(
        unplaced(n),
        world,
        np.zeros(s + 1, np.int64),
        middles,
        np.empty(g, np.uint8),
        np.zeros((model.swings.shape[0], n + 1)),
        np.zeros((model.swings.shape[0], n + 1)),
        np.empty((n, 6)),
        np.empty(_ROOM, np.int64),
        np.empty((_ROOM, 4), np.int64),
        np.empty(n),
        np.zeros((model.pairs.shape[0] + g + 1, 3)),
        np.zeros((model.pairs.shape[0] + g + 1, 2), np.int64),
        np.empty((14, 3)),
    )
    for p in range(model.pairs.shape[0]):
        for side in range(2):
            work.tips[p, side] = model.tips[model.pairs[p, side]]
    for p in range(g):
        for side in range(2):
            work.tips[model.pairs.shape[0] + p, side] = model.tips[max(model.hulls[model.groups[p, side]], 0)]
    for k in range(s):  # what does not move is where it is
        if model.bodies[k] == 0:
            for i in range(3):
                for j in range(4):
                    world[k, i, j] = model.poses[k, i, j]
    for k in range(c):
        for i in range(3):
            middles[k, i] = model.centres[k, i]
    return work


@inner_kernel
def map_room(m: int, enough: float, model: Model, work: Workspace) -> float:
    """By how much a body is further from the map than it must be; searched until it is `enough`."""
    groups, spheres, shapes, keeps = model.sphere_groups, model.spheres, model.sphere_shapes, model.sphere_keep
    field, corner, edge = model.field, model.corner, model.edge
    kinds, sizes, bodies, poses = model.kinds, model.sizes, model.bodies, model.poses
    frames, done, world, simplex = work.frames, work.done, work.world, work.simplex
    corners, firsts, rings, past, tips = model.corners, model.firsts, model.rings, work.past, work.tips
    last = tips.shape[0] - 1
    frame = frames[groups[m, 0]]
    least, cell, width = enough, kinds.shape[0] - 1, edge[0]
    for k in range(groups[m, 1], groups[m, 2]):
        room = map_distance(frame, spheres[k], field, corner, edge)
        if room >= 0.0:
            least = min(least, room)
            continue
        # the ball is too near: check the shape itself and each cell that the ball may be near to
        i, keep, least = shapes[k], keeps[k], 0.0
        put_shape(i, bodies, poses, frames, done, world)
        reach = spheres[k, 3] + width
        for r in range(3):
            x = frame[r, 3] - corner[r]
            for c in range(3):
                x += frame[r, c] * spheres[k, c]
            simplex[12, r] = max(math.floor((x - reach) / width), 0)
            simplex[13, r] = min(math.floor((x + reach) / width) + 1, field.shape[r])
        for x in range(int(simplex[12, 0]), int(simplex[13, 0])):
            for y in range(int(simplex[12, 1]), int(simplex[13, 1])):
                for z in range(int(simplex[12, 2]), int(simplex[13, 2])):
                    if field[x, y, z] > 0.0:
                        continue
                    world[cell, 0, 3] = corner[0] + (x + 0.5) * width
                    world[cell, 1, 3] = corner[1] + (y + 0.5) * width
                    world[cell, 2, 3] = corner[2] + (z + 0.5) * width
                    if kinds[i] != HULL:
                        if separation(i, cell, keep, kinds, sizes, world) < keep:
                            return -1.0
                        continue
                    tips[last, 0] = model.tips[i]
                    room = hull_separation(
                        last, i, cell, keep, keep, kinds, sizes, corners, firsts, rings, world, past, tips, simplex
                    )
                    if room < keep:
                        return -1.0
    return least


@inner_kernel
def map_distance(frame: Array, ball: Array, field: NDArray[np.float32], corner: Array, edge: Array) -> float:
    """Distance in the map at a ball's centre less its radius and what rounding to cells takes."""
    nx, ny, nz = field.shape
    inverse = 1.0 / edge[0]
    x = frame[0, 0] * ball[0] + frame[0, 1] * ball[1] + frame[0, 2] * ball[2] + frame[0, 3] - corner[0]
    y = frame[1, 0] * ball[0] + frame[1, 1] * ball[1] + frame[1, 2] * ball[2] + frame[1, 3] - corner[1]
    z = frame[2, 0] * ball[0] + frame[2, 1] * ball[1] + frame[2, 2] * ball[2] + frame[2, 3] - corner[2]
    # the nearest cell represents a point outside: what is in the map is no nearer to the point than to it
    i = min(max(math.floor(x * inverse), 0), nx - 1)
    j = min(max(math.floor(y * inverse), 0), ny - 1)
    k = min(max(math.floor(z * inverse), 0), nz - 1)
    return field[i, j, k] - ball[3] - edge[1]


#: More clearance than this is searched between the balls of clusters only, not between the shapes in them, m.
_CLOSE = 0.03


@inner_kernel
def place(q: Array, model: Model, work: Workspace) -> None:
    """Bring bodies and the centres of what moves with them to where they are in a state."""
    # fields are unpacked before loops here and below: each access costs a count of references
    frames, middles, parents, placements, axes = work.frames, work.middles, model.parents, model.placements, model.axes
    prismatic, clusters, centres = model.prismatic, model.clusters, model.centres
    place_bodies(q, parents, placements, axes, prismatic, frames, work.levers)
    for k in range(model.runs.shape[0] - 1):
        b = clusters[k]
        x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
        for r in range(3):
            middles[k, r] = frames[b, r, 0] * x + frames[b, r, 1] * y + frames[b, r, 2] * z + frames[b, r, 3]
    work.done[model.kinds.shape[0]] += 1


@inner_kernel
def sway(a: Array, b: Array, share: float, model: Model, work: Workspace) -> None:
    """Fill `Workspace.sways` about the state that bodies were placed for, for a share of the line from `a` to `b` (n,).

    Joints turn one after the other, the last one first: each moves a point by no more than its turn times the distance
    from its axis, to which what the joints before have moved it is added.
    """
    frames, prismatic, parents, levers = work.frames, model.prismatic, model.parents, work.levers
    sways, swings, middles, bounds, clusters = work.sways, model.swings, work.middles, model.bounds, model.clusters
    balls, about = model.sphere_groups, model.sphere_bounds
    moving = sways.shape[0] - balls.shape[0]
    for c in range(sways.shape[0]):
        if c < moving:
            body, radius = clusters[c], bounds[c]
            x, y, z = middles[c, 0], middles[c, 1], middles[c, 2]
        else:
            m = c - moving
            body, radius = balls[m, 0], about[m, 3]
            u, v, w = about[m, 0], about[m, 1], about[m, 2]
            x = frames[body, 0, 0] * u + frames[body, 0, 1] * v + frames[body, 0, 2] * w + frames[body, 0, 3]
            y = frames[body, 1, 0] * u + frames[body, 1, 1] * v + frames[body, 1, 2] * w + frames[body, 1, 3]
            z = frames[body, 2, 0] * u + frames[body, 2, 1] * v + frames[body, 2, 2] * w + frames[body, 2, 3]
        moved = 0.0
        sways[c, body] = 0.0
        while body > 0:
            i = body - 1
            turn = share * abs(b[i] - a[i])
            if prismatic[i]:
                moved += turn
            else:
                u, v, w = x - levers[i, 3], y - levers[i, 4], z - levers[i, 5]
                along = u * levers[i, 0] + v * levers[i, 1] + w * levers[i, 2]
                off = math.sqrt(max(u * u + v * v + w * w - along * along, 0.0)) + radius + moved
                moved += turn * min(off, swings[c, i])
            body = parents[i]
            sways[c, body] = moved


@inner_kernel
def sift(sways: Array, model: Model, work: Workspace) -> int:
    """List the groups whose balls may come too near in an interval; returns how many. Bodies in the map are added.

    Args:
        sways: `Workspace.sways` of the interval, or `Workspace.still`.
        model: The scene.
        work: Room.
    """
    near, middles, points, runs, reaches = work.near, work.middles, model.points, model.runs, model.spans
    groups, lists = model.groups, work.lists
    for c in range(runs.shape[0] - 1):
        x, y, z, more = middles[c, 0], middles[c, 1], middles[c, 2], sways[c, 0]
        for g in range(runs[c], runs[c + 1]):
            u, v, w = points[0, g] - x, points[1, g] - y, points[2, g] - z
            reach = reaches[g] + more
            near[g] = u * u + v * v + w * w <= reach * reach
    for g in range(runs[-1], groups.shape[0]):
        a, b, k = groups[g, 0], groups[g, 1], groups[g, 5]
        u, v, w = middles[b, 0] - middles[a, 0], middles[b, 1] - middles[a, 1], middles[b, 2] - middles[a, 2]
        reach = reaches[g] + sways[a, k] + sways[b, k]
        near[g] = u * u + v * v + w * w <= reach * reach
    count = 0
    for g in range(groups.shape[0]):
        if near[g]:
            lists[count] = g
            count += 1
    for g in range(groups.shape[0], groups.shape[0] + model.sphere_groups.shape[0]):
        lists[count] = g
        count += 1
    return count


@inner_kernel
def check_listed(start: int, count: int, end: int, sways: Array, model: Model, work: Workspace) -> int:
    """Check listed groups (and bodies in the map) in the state that bodies were placed for.

    Args:
        start: Index at which the list begins.
        count: Number of pairs in it.
        end: Index at which those are listed that may come too near in the interval; nothing is for -1.
        sways: Sways of the interval, or those of a state alone.
        model: The scene.
        work: Room.

    Returns:
        How many are listed at `end`; -1 when one is too near (or not proven to be far enough) in this state.
    """
    groups, middles, bounds, spans, kinds = model.groups, work.middles, model.bounds, model.spans, model.kinds
    hulls, reaches = model.hulls, model.reaches
    world, sizes, radii, pairs, keeps = work.world, model.sizes, model.radii, model.pairs, model.keep
    bodies, poses, frames, done = model.bodies, model.poses, work.frames, work.done
    lists, moving, kept = work.lists, model.runs.shape[0] - 1, 0
    balls, about, field = model.sphere_groups, model.sphere_bounds, model.field
    corner, edge, corners, firsts, rings = model.corner, model.edge, model.corners, model.firsts, model.rings
    past, tips, simplex = work.past, work.tips, work.simplex
    for at in range(start, start + count):
        g = lists[at]
        if g >= groups.shape[0]:
            m = g - groups.shape[0]
            enough = float(sways[moving + m, 0])
            if map_distance(frames[balls[m, 0]], about[m], field, corner, edge) >= enough:
                continue
            least = map_room(m, enough, model, work)
        else:
            a, b, j, k = groups[g, 0], groups[g, 1], groups[g, 4], groups[g, 5]
            enough = float(sways[a, k] + sways[b, k]) if b < moving else float(sways[a, 0])
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
                # free here; to prove more by checking each pair would cost more than it saves
                if end >= 0:
                    lists[end + kept] = g
                    kept += 1
                continue
            least = enough if close else 0.0
            i, j = int(hulls[a]), int(hulls[b])
            if i >= 0 and j >= 0 and groups[g, 3] - groups[g, 2] > 1:
                put_shape(i, bodies, poses, frames, done, world)
                put_shape(j, bodies, poses, frames, done, world)
                keep = float(reaches[g])
                need, p = keep + least, pairs.shape[0] + g
                proven = hull_separation(
                    p, i, j, keep, need, kinds, sizes, corners, firsts, rings, world, past, tips, simplex
                )
                if proven >= keep:
                    if end >= 0 and proven - keep < enough:
                        lists[end + kept] = g
                        kept += 1
                    continue
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
                need = keep + least
                if kinds[i] == HULL or kinds[j] == HULL:
                    proven = hull_separation(
                        p, i, j, keep, need, kinds, sizes, corners, firsts, rings, world, past, tips, simplex
                    )
                else:
                    proven = separation(i, j, need, kinds, sizes, world)
                least = min(least, proven - keep)
                if least < 0.0:
                    return -1
        if least < 0.0:
            return -1
        if end >= 0 and least < enough:
            lists[end + kept] = g
            kept += 1
    return kept


@bare_kernel
def near(q: Array, model: Model, work: Workspace) -> bool:
    """Whether in a state (n,) something is not proven to be as far from all else as it must be."""
    place(q, model, work)
    return check_listed(0, sift(work.still, model, work), -1, work.still, model, work) < 0


@kernel
def states_free(states: Array, model: Model, out: NDArray[np.bool_]) -> None:
    """Whether each of the states (m, n) is proven free."""
    work = workspace(model)
    for k in range(states.shape[0]):
        out[k] = not near(states[k], model, work)
