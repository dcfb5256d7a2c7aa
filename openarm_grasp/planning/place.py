# SPDX-License-Identifier: Apache-2.0
"""Where to put an object down, and how the hand stands there.

The object keeps its place in the hand: ``T_base_tcp(place) = T_base_object(place) @ inv(T_base_object(grasp)) @
T_base_tcp(grasp)``. It is released just above the table, and its yaw is free, so that a hand that could not stand one
way may stand another.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import product
from math import hypot, inf

import numpy as np
from scipy.spatial import KDTree

from openarm_common import se3
from openarm_common.detection import Detection, distances_from
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.work import Table
from openarm_common.types import Array, Floats
from openarm_common.wanted import describe, select
from openarm_grasp.config import GraspConfig, PlaceConfig
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.perception.sightings import surface_of
from openarm_grasp.planning.arms import Shoulders, sides
from openarm_grasp.planning.candidates import UP, GraspCandidate, PlaceTarget, hold_of

#: Edges of a footprint that differ by less are taken for equal, m; those of what is round are, too.
_SQUARE_WITHIN = 0.006
#: Spots nearer to each other than this are one, m.
SAME_SPOT = 0.02
#: What reaches farther from its middle is large, m: distances to it are those to its outline, and so much.
_LARGE = 0.05
#: A point of the table that is in view is this near to a spot that nothing hides, m.
_SEEN = 0.03
#: An object may be so much wider than what it is placed on, on each side, m.
_OVERHANG = 0.01
#: Grid of spots there, their distance from what stands there, and room around that is enough for a hand, m.
_SPOT_STEP, _NEXT, _HAND_ROOM = 0.02, 0.005, 0.08


def place_targets(
    target: Detection,
    candidate: GraspCandidate,
    spots: Sequence[Array],
    config: GraspConfig,
    used: Sequence[PlaceTarget] = (),
    *,
    yaw: float | None = None,
) -> tuple[PlaceTarget, ...]:
    """Hand poses that put the object on each of the spots, best first: earlier spots, then smaller turns.

    Args:
        target: The object as it stood at the grasp.
        candidate: Grasp that holds it.
        spots: (3,) footprint centres on what it is to stand on, base frame, m, best first; (2,): as high as it stood.
        config: Parameters.
        used: Targets that have failed before: their spots (where there are others) or turns come last.
        yaw: Yaw of the object's x axis about the base z when it stands there, rad; None: any.
    """
    T_object_tcp = se3.inverse(target.T_base_object) @ candidate.T_base_tcp
    yaws = yaw_offsets(config.place.yaw_step_deg) if yaw is None or target.round else turns_to(target, yaw)
    # Small turns of every spot come first: a hopeless spot must not use up the planner's patience. Turns of one spot
    # score alike, so that the planner takes the one that is near.
    n = len(spots)
    ranked = [
        (2 * n * _failed(used, spot, yaw, any_turn=n > 1) + n * (abs(yaw) > np.pi / 4.0) + i, i, yaw)
        for i, spot in enumerate(spots)
        for yaw in yaws
    ]
    order = sorted(ranked, key=lambda r: r[0])
    found: list[PlaceTarget] = []
    for rank, i, yaw in order:
        foot = np.array([*spots[i], target.bottom][:3], dtype=np.float64)
        p = foot + (target.p_base[2] - target.bottom + config.place.release_height) * UP
        T_base_tcp = se3.make(se3.rot_z(yaw) @ target.T_base_object[:3, :3], p) @ T_object_tcp
        found.append(
            PlaceTarget(
                id=f"spot{i}/yaw{np.degrees(yaw):+.0f}",
                T_base_tcp=T_base_tcp,
                position=foot,
                yaw_offset=yaw,
                approach_offset=config.approach.pregrasp_distance * UP,
                retreat_offset=-config.approach.pregrasp_distance * T_base_tcp[:3, 2],
                score=-float(rank),
            )
        )
    return tuple(found)


def other_grasps(
    offered: Sequence[GraspCandidate], failed: GraspCandidate, code: Code, target: Detection, yaw: float | None
) -> tuple[GraspCandidate, ...]:
    """What to try when a grasp can be planned, but nowhere to put the object with it.

    Hands that stand alike at the place have its fate: where turns are free, those whose approach leans alike; else
    those that differ by a turn after which the object looks the same. A search that found no path says nothing about
    them: it began elsewhere.

    Args:
        offered: Grasps that were offered to the planner.
        failed: The one that it chose.
        code: Why the place was refused.
        target: The object as it stands.
        yaw: Yaw that is wanted, rad; None: any.
    """
    if code is Code.NO_PLAN:
        return tuple(c for c in offered if hold_of(c) != hold_of(failed))
    step = 0.0 if yaw is None or target.round else symmetry(target)
    return tuple(c for c in offered if not _stands_alike(c, failed, step))


def _stands_alike(a: GraspCandidate, b: GraspCandidate, step: float) -> bool:
    """Whether two hands differ by a turn about the vertical, of whole steps (rad; 0: of any angle)."""
    R_a, R_b = a.T_base_tcp[:3, :3], b.T_base_tcp[:3, :3]
    if not np.allclose(R_a[2], R_b[2], atol=1e-6):
        return False
    if step == 0.0:
        return True
    (ax, ay), (bx, by) = R_a[:2, 1], R_b[:2, 1]
    steps = np.arctan2(ax * by - ay * bx, ax * bx + ay * by) / step
    return abs(steps - round(steps)) < 1e-6


def symmetry(target: Detection) -> float:
    """Turn after which a box looks the same, rad: half of one, a quarter for a square."""
    return np.pi / 2.0 if abs(float(target.size[0] - target.size[1])) < _SQUARE_WITHIN else np.pi


def other_spots(ways: Sequence[PlaceTarget], used: Sequence[PlaceTarget]) -> tuple[PlaceTarget, ...]:
    """Ways to put something down at spots where none has failed; all of them, where there is no other spot."""
    others = tuple(way for way in ways if not _failed(used, way.position, way.yaw_offset, any_turn=True))
    return others or tuple(ways)


def _failed(used: Sequence[PlaceTarget], spot: Array, yaw: float, *, any_turn: bool) -> bool:
    return any(
        np.linalg.norm(t.position[:2] - spot[:2]) < SAME_SPOT and (any_turn or abs(t.yaw_offset - yaw) < 1e-6)
        for t in used
    )


def yaw_offsets(step_deg: float) -> tuple[float, ...]:
    """Turns to try, rad, in (-pi, pi]: 0, then ± one step, ± two steps, and so on."""
    steps = range(1, int((180.0 - 1e-9) // step_deg) + 1)
    offsets = [sign * float(np.radians(k * step_deg)) for k in steps for sign in (1.0, -1.0)]
    half_turn = [float(np.pi)] if abs((len(steps) + 1) * step_deg - 180.0) < 1e-9 else []
    return (0.0, *offsets, *half_turn)


def turns_to(target: Detection, yaw: float) -> tuple[float, ...]:
    """Turns that give a box a yaw, rad, smallest first; it looks the same after half a turn, a square one a quarter."""
    step = symmetry(target)
    first = (yaw - target.yaw) % step
    turns = [(first + k * step + np.pi) % (2.0 * np.pi) - np.pi for k in range(round(2.0 * np.pi / step))]
    return tuple(sorted((float(turn) for turn in turns), key=abs))


def free_spots(
    arm: str,
    target: Detection,
    others: Sequence[Detection],
    config: GraspConfig,
    shoulders: Shoulders,
    choices: Sequence[Sequence[float]] = (),
    *,
    seen: Array | Floats | None = None,
    every: bool = False,
) -> tuple[Array, ...]:
    """Free spots, best first: of those that may be chosen, or anywhere on the arm's side of the table.

    A spot keeps its distance from every other object and from where the object came; where none does, it is one where
    the object fits. Those come first where it fits in whatever its turn, then those that leave room for a hand around
    the others; among them, room around it counts (up to twice the distance asked for) and nearness to where it came
    from, which keeps the carry short.

    Args:
        arm: Arm whose side.
        target: The object as it stood at the grasp.
        others: Other objects in view.
        config: Parameters.
        shoulders: Shoulders of the arms.
        choices: (x, y) of spots, base frame, m; none: a grid on the arm's side.
        seen: (n, 3) points of the table that are in view: spots that nothing hides come first; None: all are.
        every: All that there are, not only `config.place.spots`; where it came from is one when nothing else is free.

    Raises:
        OpenArmError: PLACE_FAILED, when it fits nowhere.
    """
    place = config.place
    ys = np.concatenate([grid(*place.region_abs_y, place.spot_step) * side for side in sides(arm, shoulders)])
    spots = choices or [*product(grid(*place.region_x, place.spot_step), ys)]
    reach = 0.5 * float(np.hypot(*target.size[:2]))
    clear = clear_spots(spots, target, others, place)
    if not clear:
        fitting = {"neighbour_distance": 0.0, **({"origin_distance": 0.0} if every else {})}
        clear = clear_spots(spots, target, others, place.model_copy(update=fitting))
    if not clear:
        what = f"none of {len(choices)} places is free" if choices else f"no free spot for the {arm} arm"
        raise OpenArmError(
            Code.PLACE_FAILED,
            f"{what}: {target.label!r}, {min(target.size[:2]) * 1e3:.0f} mm wide, fits nowhere between"
            f" {len(others)} other objects",
        )
    xy = np.array([spot[2:] for spot in clear])
    room = np.min([np.full(len(xy), inf), *(distances_from(d, xy) for d in others)], axis=0)
    hidden = np.zeros(len(xy)) if seen is None or not len(seen) else KDTree(seen[:, :2]).query(xy)[0]
    ranked = [
        (bool(free < reach), dark > _SEEN, clearance < place.neighbour_room, cost, x, y)
        for free, dark, (cost, clearance, x, y) in zip(room, hidden, clear, strict=True)
    ]
    # Six spots side by side would share one fate, so those offered lie apart.
    chosen: list[Array] = []
    for *_, x, y in sorted(ranked):
        spot = np.array([x, y])
        if all(np.linalg.norm(spot - other) >= 1.9 * place.spot_step for other in chosen):
            chosen.append(spot)
        if len(chosen) == place.spots and not every:
            break
    return tuple(chosen)


def clear_spots(
    spots: Iterable[Sequence[float]], target: Detection, others: Sequence[Detection], config: PlaceConfig
) -> list[tuple[float, float, float, float]]:
    """Spots that keep their distance from the middles of other objects and from where the object came from.

    It is not over their outlines there, turned as it fits.

    Args:
        spots: (x, y) of each, base frame, m.
        target: The object as it stood at the grasp.
        others: Other objects in view.
        config: The distances.

    Returns:
        Cost, clearance to the nearest object, x and y of each, m. The cost is the distance from where the object came
        from, less the clearance up to twice the distance asked for.
    """
    found: list[tuple[float, float, float, float]] = []
    xys = np.array([[float(spot[0]), float(spot[1])] for spot in spots])
    outlines = np.min([np.full(len(xys), inf), *(distances_from(d, xys) for d in others)], axis=0)
    least = 0.5 * float(min(target.size[:2])) + _NEXT
    for (x, y), outline in zip(xys.tolist(), outlines.tolist(), strict=True):
        origin = hypot(x - target.p_base[0], y - target.p_base[1])
        middle = min((hypot(x - d.p_base[0], y - d.p_base[1]) for d in others), default=inf)
        if origin >= config.origin_distance and middle >= config.neighbour_distance and outline >= least:
            clearance = min(middle, outline + _LARGE)  # of what is large the middle may be far
            found.append((origin - min(clearance, 2.0 * config.neighbour_distance), clearance, x, y))
    return found


def check_position(position: Sequence[float], target: Detection, others: Sequence[Detection], table: Table) -> Array:
    """A place position that a user asked for.

    Args:
        position: x, y (and a z that is not read), base frame, m.
        target: The object that is to stand there.
        others: Other objects in view.
        table: Table whose top it must be on.

    Returns:
        (2,) position.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it is not finite or not on the table; IN_COLLISION, when another object is
            there.
    """
    p = np.asarray(position, dtype=np.float64)[:2]
    half = float(min(target.size[:2])) / 2.0
    (x_min, x_max), (y_min, y_max) = table.x, table.y
    # Not finite compares false, too.
    if not (x_min + half <= p[0] <= x_max - half and y_min + half <= p[1] <= y_max - half):
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"place position ({p[0]:.3f}, {p[1]:.3f}) m is not on the table: expected x in [{x_min + half:.3f},"
            f" {x_max - half:.3f}] and y in [{y_min + half:.3f}, {y_max - half:.3f}] for {target.label!r}",
        )
    for d in others:
        distance = float(np.linalg.norm(d.p_base[:2] - p))
        if distance < half + float(min(d.size[:2])) / 2.0:
            raise OpenArmError(
                Code.IN_COLLISION,
                f"{d.label!r} stands {distance * 1e3:.0f} mm from the place position ({p[0]:.3f}, {p[1]:.3f}) m:"
                f" {target.label!r} does not fit there",
            )
    return p


def spots_on(name: str, found: Sighting, config: PlaceConfig) -> tuple[Array, ...]:
    """Free spots on the top of something in view, or in it, best first: those with most room around, then the middle.

    Args:
        name: Words for it.
        found: The object that is to stand there, and what is around it.
        config: Number of spots that are offered.

    Returns:
        (3,) footprint centres on its surface, base frame, m.

    Raises:
        OpenArmError: UNKNOWN_OBJECT or NOTHING_DETECTED, naming what may carry; PLACE_FAILED, when nothing is free.
    """
    target, others = found.target, found.others
    try:
        support = select(name, others)[0]
    except OpenArmError as error:
        text = f"no {name!r} to place {target.label!r} on or in; in view: {describe(others)}"
        raise OpenArmError(error.code, text) from error
    standing = [d for d in others if d is not support and distances_from(support, d.p_base[None, :2])[0] == 0.0]
    floor = surface_of(support, found)
    reach = 0.5 * float(max(target.size[:2]))
    room = 0.5 * support.size[:2] - reach
    if (room < -_OVERHANG).any():
        raise OpenArmError(
            Code.PLACE_FAILED,
            f"{target.label!r} does not fit on {name!r}, which is {support.size[0] * 1e3:.0f} mm ×"
            f" {support.size[1] * 1e3:.0f} mm large",
        )
    axes = [np.linspace(-r, r, 1 + 2 * int(r / _SPOT_STEP)) if r > 0.0 else np.zeros(1) for r in room]
    flat = np.array(list(product(*axes))) @ support.T_base_object[:2, :2].T + support.p_base[:2]
    free = np.min([np.full(len(flat), inf), *(distances_from(d, flat) for d in standing if d.top > floor)], axis=0)
    away = np.linalg.norm(flat - support.p_base[:2], axis=1)
    order = [i for i in np.lexsort((away, -np.minimum(free, _HAND_ROOM).round(3))) if free[i] >= reach + _NEXT]
    if not order:
        text = f"no free spot on {name!r}: {len(standing)} objects stand there, and {target.label!r} needs"
        raise OpenArmError(Code.PLACE_FAILED, f"{text} {reach * 1e3:.0f} mm around its middle")
    return tuple(np.array([*flat[i], floor]) for i in order[: 2 * config.spots])


def grid(low: float, high: float, step: float) -> Array:
    """Numbers from one end to the other, about a step apart."""
    return np.linspace(low, high, max(2, round((high - low) / step) + 1))


def placing_error(label: str, target: PlaceTarget, frame: Frame) -> tuple[Array, float] | None:
    """How far the camera sees a placed prism from where the hand let it go, along the opening axis of the hand.

    Args:
        label: Label of the object.
        target: Target where it was let go.
        frame: Observed since.

    Returns:
        Unit direction (2,), base frame, and the distance along it, m; None when the object is not in the frame, or
        has no sides that the hand centres.
    """
    off = [(d.p_base - target.position)[:2] for d in frame.detections if d.label == label and d.measured and d.kind]
    if not off:
        return None
    axis = target.T_base_tcp[:2, 1] / np.linalg.norm(target.T_base_tcp[:2, 1])
    return axis, float(axis @ min(off, key=lambda v: float(np.linalg.norm(v))))
