# SPDX-License-Identifier: Apache-2.0
"""Lines of a closed hand that push an object: into reach, away from its neighbours, or a heap apart.

A closed hand comes down next to what it pushes, low, and goes along a straight line. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from math import ceil, cos, hypot, inf, pi, radians, sin

import numpy as np
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.hand import HandParts
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import NEXT_TO, Sighting
from openarm_grasp.perception.sightings import in_box, object_points, points_around, tops
from openarm_grasp.planning.candidates import UP, Box, GraspCandidate, tips_height
from openarm_grasp.planning.neighbours import standing_boxes

#: Between two points of a hand's shape, m.
_GRAIN = 0.005
#: Points no further behind the foremost than this are at the front, m.
_FLAT = 0.002
#: Of a closed hand, this much from the tips on goes between things, m.
_TIPS = 0.03
#: Rows along a line in which things meet, those at the border of one slide past; how near they come to meet, m.
_ROW, _MEET = 0.006, 0.004
#: Things are not pushed farther than this beyond where arms reach, and no farther than this at once, m.
_BEYOND, _LONGEST = 0.05, 0.30
#: What is pushed over other things is taken for so much shorter below: they may reach a little higher, m.
_OVER = 0.01
#: Share of a line by which what stands where no arm reaches must come nearer to there.
_COMES = 0.5
#: A line away from the middle of the crowd may be so much longer, m.
_OUTWARD = 0.10


@dataclass(frozen=True, eq=False)
class Sweep:
    """A line of a closed hand through things that stand close together.

    Attributes:
        met: Box about what the hand meets on it.
        end: (2,) where the middle of that box goes.
        freed: (2,) where the object should be afterwards.
        heap: Boxes about the object and all that is pushed along with it, as far as it is at the height of the hand.
        under: Boxes about the same down to the table.
        rest: Other objects around.
    """

    met: Detection
    end: Array
    freed: Array
    heap: tuple[Box, ...]
    under: tuple[Box, ...]
    rest: tuple[Detection, ...]


def sweeps(
    found: Sighting,
    hand: Array,
    context: GraspContext,
    lengths: Sequence[float],
    *,
    level: float = 0.0,
    longest: bool = False,
) -> tuple[Sweep, ...]:
    """Find lines that push an object away from where it stands, those first that move, and end next to, the least else.

    A line begins behind the object, or behind what touches it there. Pushing along such lines makes room for grasps
    in heaps (Danielczuk et al., "Linear push policies to increase grasp access for robot bin picking", CASE 2018).

    Args:
        found: The object and its neighbours.
        hand: Points (n, 3) of the closed hand, TCP frame.
        context: Parameters and table.
        lengths: Lengths of the way of the object, m.
        level: Height of the hand above the table, m: it goes over what is lower, and meets what lies on that.
        longest: Try the longest first of lines that move as many things, else short ones that lead outwards.
    """
    config, table = context.config, context.table.top_z
    floor, around = table + level, points_around(found.clouds)
    standing = {0: _standing(object_points(found.clouds), found.target, floor)}
    standing |= {i: _standing(around[in_box(around, one)], one, floor) for i, one in enumerate(found.others, start=1)}
    if not len(standing[0]) or (level > 0.0 and standing[0][:, 2].max() < floor + 2.0 * _OVER):
        return ()
    numbers = [i for i, cells in standing.items() if len(cells)]
    things = [standing[i] for i in numbers]
    half = float(np.abs(hand[hand[:, 2] > hand[:, 2].max() - _TIPS, :2]).max()) + _MEET
    room = 2.0 * (half + config.push.gap)
    crowd = np.concatenate(things)[:, :2].mean(axis=0)
    ways: list[tuple[int, float, Sweep]] = []
    for length, k in product(lengths, range(config.push.directions)):
        R = se3.rot_z(2.0 * pi * k / config.push.directions)
        ahead = R[:2, 0]
        if not _nearer(found.target.p_base[:2], length * ahead, context):
            continue
        line = _line([thing @ R for thing in things], half, room, length)
        if line is None:
            continue
        begin, near, far, moved = line
        cells, whole = np.concatenate([things[i] for i in moved]), near - begin + length
        if whole > _LONGEST or not _allowed(cells[:, :2], whole * ahead, context):
            continue
        aside = float(np.median(things[0] @ R[:, 1]))
        local = cells @ R
        met = cells[(np.abs(local[:, 1] - aside) <= half) & (local[:, 0] >= begin) & (local[:, 0] <= far)]
        tall = float(met[:, 2].max()) - floor
        p = R @ np.array([0.5 * (begin + far), aside, 0.0])
        size = np.array([far - begin + _GRAIN, 2.0 * half, tall])
        box = replace(found.target, T_base_object=se3.make(R, p + (floor + 0.5 * tall) * UP), size=size, round=False)
        heap = standing_boxes(found.target.label, cells, floor, config.approach.table_gap if level == 0.0 else _OVER)
        under = standing_boxes(f"{found.target.label}/under", cells, table, 0.0) if level > 0.0 else ()
        along = {numbers[i] for i in moved}
        rest = tuple(one for i, one in enumerate(found.others, start=1) if i not in along)
        sweep = Sweep(box, p[:2] + whole * ahead, found.target.p_base[:2] + length * ahead, heap, under, rest)
        out = float(ahead @ direction(things[0][:, :2].mean(axis=0) - crowd))
        ends = KDTree(cells[:, :2] + whole * ahead)
        near = sum(ends.query(one[:, :2])[0].min() < NEXT_TO for i, one in enumerate(things) if i not in moved)
        ways.append((len(moved) + near, -length if longest else whole - _OUTWARD * out, sweep))
    return tuple(sweep for _, _, sweep in sorted(ways, key=lambda way: way[:2]))


def _standing(points: Array, one: Detection, floor: float) -> Array:
    """Highest points (n, 3) above a height of the columns of an object; of its box where no points of it are known."""
    if len(points) == 0:
        edges = [np.linspace(-0.5, 0.5, max(2, round(edge / _GRAIN) + 1)) * edge for edge in one.size[:2]]
        grid = np.stack(np.meshgrid(*edges, [0.5 * one.size[2]], indexing="ij"), axis=-1).reshape(-1, 3)
        points = se3.apply(one.T_base_object, grid)
    points = points[points[:, 2] > floor + _MEET]
    return tops(points) if len(points) else points


def _line(
    things: Sequence[Array], half: float, room: float, length: float
) -> tuple[float, float, float, tuple[int, ...]] | None:
    """A line along x through the middle of the first of several things.

    Args:
        things: (n, 3) columns of each; x along the line.
        half: Half of the width that the hand takes, m.
        room: Free length that it needs to come down, m.
        length: Length of the way of the first thing, m.

    Returns:
        Where what the hand meets begins; where the first thing begins and ends; which are moved. None when the hand
        would pass over the first thing.
    """
    aside = float(np.median(things[0][:, 1]))
    inside = [thing[np.abs(thing[:, 1] - aside) <= half, 0] for thing in things]
    if not len(inside[0]):
        return None
    near, far = float(inside[0].min()), float(inside[0].max())
    begin, every = near, np.sort(np.concatenate(inside))
    for x in every[every < near][::-1]:
        if begin - x >= room:
            break
        begin = float(x)
    origin = np.min([thing[:, :2].min(axis=0) for thing in things], axis=0)
    cells = [np.floor((thing[:, :2] - origin) / _ROW).astype(np.int64) for thing in things]
    steps = ceil((length + _MEET) / _ROW)
    rows, lanes = np.max([c.max(axis=0) for c in cells], axis=0)
    swept = np.zeros((rows + steps + 1, lanes + 1), np.bool_)
    moved: list[int] = []
    now = [i for i, x in enumerate(inside) if ((x >= begin) & (x <= far)).any()]
    while now:
        moved += now
        for i, step in product(now, range(steps + 1)):
            swept[cells[i][:, 0] + step, cells[i][:, 1]] = True
        inner = np.zeros_like(swept)
        inner[:, 1:-1] = swept[:, :-2] & swept[:, 1:-1] & swept[:, 2:]
        now = [i for i, c in enumerate(cells) if i not in moved and inner[c[:, 0], c[:, 1]].any()]
    return begin, near, far, tuple(sorted(moved))


def _allowed(xy: Array, step: Array, context: GraspContext) -> bool:
    """Whether all of (n, 2) stays on the table, and about where arms reach, or comes nearer to there."""
    return bool((_outside(xy + step, context, _BEYOND) <= _outside(xy, context, _BEYOND)).all())


def _nearer(xy: Array, step: Array, context: GraspContext) -> bool:
    """Whether what stands (2,) where no arm reaches comes nearer to there; true of what stands elsewhere."""
    off = float(np.linalg.norm(_outside(xy, context)))
    after = float(np.linalg.norm(_outside(xy + step, context)))
    return off == 0.0 or after <= max(off - _COMES * float(np.linalg.norm(step)), 0.0)


def _outside(xy: Array, context: GraspContext, beyond: float = 0.0) -> Array:
    """How far (…, 2) are off the table, or off where arms reach and a margin beyond that, along each axis, m."""
    table, place = context.table, context.config.place
    side = place.region_abs_y[1] + beyond
    low = np.maximum([table.x[0], table.y[0]], [place.region_x[0] - beyond, -side])
    high = np.minimum([table.x[1], table.y[1]], [place.region_x[1] + beyond, side])
    return np.maximum(np.maximum(low - xy, xy - high), 0.0)


def destinations(target: Detection, others: Sequence[Detection], context: GraspContext) -> tuple[Array, ...]:
    """Places around the object, on the table and free of others.

    Those nearest to where arms reach come first, then short pushes, then those to the sides.

    Args:
        target: The object.
        others: Other objects on the table.
        context: Parameters and table.
    """
    config, place, table = context.config.push, context.config.place, context.table
    p, half = target.p_base[:2], 0.5 * float(np.hypot(*target.size[:2]))
    found: list[tuple[float, float, float, float, float]] = []
    for length, k in product(config.lengths, range(config.directions)):
        angle = 2.0 * pi * k / config.directions
        x, y = float(p[0] + length * cos(angle)), float(p[1] + length * sin(angle))
        room = min((hypot(x - d.p_base[0], y - d.p_base[1]) for d in others), default=inf)
        on_table = table.x[0] + half <= x <= table.x[1] - half and table.y[0] + half <= y <= table.y[1] - half
        if on_table and room >= place.neighbour_distance:
            off = round(float(np.linalg.norm(_outside(np.array([x, y]), context))), 3)
            found.append((off, length, -round(abs(sin(angle)), 3), x, y))
    return tuple(np.array([x, y]) for *_, x, y in sorted(found))


def push_ways(
    target: Detection,
    end: Array,
    config: GraspConfig,
    hand: Array,
    measures: HandParts,
    turns_deg: Sequence[float] = (0.0,),
) -> tuple[GraspCandidate, ...]:
    """How a closed hand may stand behind the object, the most upright first.

    One of its four faces points ahead, so that a flat side of the object is met flat; it leans sideways, or with its
    tips ahead, never over the object. Whatever part of the hand comes first must meet the object at half of its height
    or lower, else the object would tip over.

    Args:
        target: The object.
        end: (2,) where it should be pushed.
        config: Parameters.
        hand: Points (n, 3) of the closed hand, TCP frame.
        measures: Measures of the hand.
        turns_deg: Turns of the hand about the vertical against that, deg.
    """
    way = np.array([*(end - target.p_base[:2]), 0.0])
    ahead = direction(way)
    aside = np.cross(UP, ahead)
    half, half_width = (
        0.5 * float(np.abs(target.T_base_object[:3, :2].T @ v) @ target.size[:2]) for v in (ahead, aside)
    )
    tall = float(target.size[2])
    faces = (("ahead+", ahead), ("ahead-", -ahead), ("aside+", aside), ("aside-", -aside))
    found: list[GraspCandidate] = []
    for (name, face), turn_deg, tilt_deg, lean in product(faces, turns_deg, config.push.tilts_deg, (1.0, -1.0)):
        y_tool = se3.rot_z(radians(turn_deg)) @ face
        heading = lean * np.cross(UP, y_tool)
        if (tilt_deg == 0.0 and lean < 0.0) or float(heading @ ahead) < -1e-6:
            continue
        tilt = radians(tilt_deg)
        R = se3.rotation_from_z_y(sin(tilt) * heading - cos(tilt) * UP, y_tool)
        height = tips_height(tilt, measures)
        met = _front(hand @ R.T, ahead, half_width, (-height, tall - height))
        if met is None or met[1] + height > 0.5 * tall:
            continue
        front, turn = met[0], f"{turn_deg:+g}" if turn_deg else ""
        p = target.p_base - (half + front + config.push.gap) * ahead
        p[2] = target.bottom + height
        found.append(
            GraspCandidate(
                id=f"{target.label}/push/{name}{turn}/tilt{tilt_deg:g}" + (f"/lean{lean:+g}" if tilt_deg else ""),
                T_base_tcp=se3.make(R, p),
                approach_offset=config.approach.pregrasp_distance * UP,
                retreat_offset=way + config.push.gap * ahead,
                width=0.0,
                tilt=tilt,
                score=-tilt,
                parts={"tilt": -tilt},
            )
        )
    return tuple(sorted(found, key=lambda c: -c.score))


@cache
def closed_hand(description: RobotDescription, arm: str) -> Array:
    """Points (n, 3) of the hand and its closed fingers, some mm apart, TCP frame, m."""
    tcp, palm, hand = description.tcp_link(arm), description.arm(arm).hand, description.hand(arm)
    links = [link for link in description.links if palm in {link, *(j.parent for j in description.chain(link))}]
    poses = description.link_poses({**dict.fromkeys(description.joints, 0.0), hand.joint: hand.closed})
    T_tcp_base = se3.inverse(poses[tcp])
    found = [np.zeros((1, 3))]
    for link in links:
        for part in description.links[link].collision:
            if part.kind == "box":
                steps = [np.linspace(-0.5, 0.5, max(2, round(edge / _GRAIN) + 1)) * edge for edge in part.size]
                grid = np.stack(np.meshgrid(*steps, indexing="ij"), axis=-1).reshape(-1, 3)
                found.append(se3.apply(T_tcp_base @ poses[link] @ part.T_link_primitive, grid))
    return np.vstack(found)


def _front(points: Array, ahead: Array, half_width: float, height: tuple[float, float]) -> tuple[float, float] | None:
    """How far the parts of the hand that can meet the object reach ahead of the TCP, and how low the foremost does, m.

    None: the hand goes over what is so thin.

    Args:
        points: (n, 3) of the hand's surface, axes of the base, from the TCP.
        ahead: (3,) direction.
        half_width: Half of the object's width across that direction, m.
        height: Height of the object's lower and upper face above the TCP, m.
    """
    across = np.abs(points @ np.cross(UP, ahead))
    low, high = height
    meets = points[(across <= half_width + _FLAT) & (points[:, 2] > low) & (points[:, 2] < high + _FLAT)]
    if not len(meets):
        return None
    reach = meets @ ahead
    front = float(reach.max())
    return front, float(meets[reach > front - _FLAT, 2].min())


def direction(v: Array) -> Array:
    """Unit vector; zeros of zeros."""
    size = float(np.linalg.norm(v))
    return v / size if size > 0.0 else v
