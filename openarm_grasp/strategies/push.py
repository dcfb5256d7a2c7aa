# SPDX-License-Identifier: Apache-2.0
"""Push an object into reach, or away from its neighbours.

A closed hand goes behind it, low, and along a straight line; an observation follows.

A hand comes to more places than it can grasp at: a grasp also needs room above, and one of a few yaws. Where an object
can be pushed is not written down but planned: the way behind the object, straight down, and the line itself, with the
object as what the hand carries, so that both keep clear of everything else. Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import product
from math import cos, hypot, inf, pi, radians, sin

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.hand import HandParts
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting, seen_at
from openarm_grasp.planning.candidates import UP, GraspCandidate, displaced, tips_height
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.planning.offers import offers
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.requests.confirm import PUSH, agree
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.robot.skills import STOPS, reraise_stop
from openarm_grasp.strategies.pick_and_place import pick_and_place

#: Between two points of a hand's shape, m.
_GRAIN = 0.005
#: Points no further behind the foremost than this are at the front, m.
_FLAT = 0.002


@dataclass(frozen=True)
class Push:
    """A push that was planned.

    Attributes:
        arm: Whose hand.
        start: (2,) where the object stands.
        end: (2,) where it should stand afterwards.
        way: How the hand stands behind it, and its line.
        plan: The trajectories.
    """

    arm: str
    start: Array
    end: Array
    way: GraspCandidate
    plan: Planned

    def __str__(self) -> str:
        """Sentence for the status."""
        (x0, y0), (x1, y1) = self.start, self.end
        return f"the {self.arm} hand pushes it from ({x0:.3f}, {y0:.3f}) to ({x1:.3f}, {y1:.3f}) m, into reach"


async def push(task: Task) -> GraspOutcome | None:
    """Push an object that no arm can grasp where it is into reach, observe, and pick it; several times if need be."""
    refused = task.outcome
    if refused is None or task.findings.place_refused:
        return None
    for number in range(1, task.context.config.push.most + 1):
        found = task.findings.need_sighting()
        if not found.target.measured:
            return None  # how far it reaches is not known
        try:
            planned = await plan_push(task, found)
        except OpenArmError as error:
            if number == 1 or error.code not in NO_WAY:
                raise
            return replace(refused, message=f"{refused.message}; after {number - 1} pushes {error.message}")
        if task.request.dry_run:
            return replace(refused, code=Code.OK, message=f"can be done: {planned}", proof=Feasible(str(planned)))
        standing = (found.target, *found.others)
        changed = await agree(task, planned.arm, str(planned), [(PUSH, planned.plan)], task.note, standing)
        if changed:
            raise OpenArmError(Code.STALE_DATA, f"{changed.removesuffix('; planning again')}; ask again")
        task.attempts = max(task.attempts, 1)
        try:
            pushed, observed = await carry_out_push(task, planned, found, number)
        except OpenArmError as error:
            return replace(refused, code=error.code, message=error.message)
        task.displaced = "after the pushes"
        refused = await pick_and_place(task, replace(task.request.about(pushed), why=observed))
        if refused.success:
            return replace(refused, message=f"{refused.message}; {observed}")
        if not task.may_go_on(refused) or task.findings.place_refused:
            break
    return refused


async def plan_push(task: Task, found: Sighting) -> Push:
    """Find a push after which the object can be grasped.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when there is none; what the robot raises.
    """
    faults: list[str] = []
    ends = destinations(found.target, found.others, task.context)
    ways = _ways_alone(task.context, found) if ends else {}
    for end in ends:
        x, y = end
        try:
            return await _push_to(task, found, end, await _taker(task, found, end, ways))
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            faults.append(f"to ({x:.3f}, {y:.3f}) m: {error.message}")
    why = f"{faults[0]} ({len(faults) - 1} other pushes refused)" if faults else "there is no free place around it"
    raise OpenArmError(Code.UNREACHABLE, f"it cannot be pushed into reach either: {why}")


def _ways_alone(context: GraspContext, found: Sighting) -> Mapping[str, tuple[GraspCandidate, ...]]:
    """Grasps of the object without its neighbours by arm: they are the same wherever it stands alone.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when no hand fits around it even then.
    """
    clouds = (replace(c, points=c.points[c.labels != 2], labels=c.labels[c.labels != 2]) for c in found.clouds)
    alone = replace(found, others=(), clouds=tuple(clouds))
    ways: dict[str, tuple[GraspCandidate, ...]] = {}
    fault = ""
    for arm in context.shoulders:
        try:
            ways[arm] = offers(context, arm, alone)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            fault = error.message
    if not ways:
        raise OpenArmError(Code.UNREACHABLE, f"a push would not help either: {fault}")
    return ways


async def _taker(task: Task, found: Sighting, end: Array, ways: Mapping[str, tuple[GraspCandidate, ...]]) -> str:
    """The arm that grasps the object there, by its grasps where the object stands now."""
    feasible, fault = FeasibilityCheck(task.robot, task.context), OpenArmError(Code.UNREACHABLE, "no arm")
    there, step = seen_at(found, end), np.array([*(end - found.target.p_base[:2]), 0.0])
    for arm in (arm for arm in task.context.arm_order("auto", float(end[1])) if arm in ways):
        offered = tuple(displaced(one, step) for one in ways[arm])
        refusal = await feasible.refusal(arm, there, now=found, offered=offered)
        if refusal is None:
            return arm
        fault = refusal
    raise fault


async def _push_to(task: Task, found: Sighting, end: Array, taker: str) -> Push:
    """The other arm is asked first: it comes from the other side."""
    config, robot, faults = task.context.config, task.robot, list[str]()
    for arm in sorted(robot.description.arm_names, key=lambda arm: arm == taker):
        ways = push_ways(found.target, end, config, closed_hand(robot.description, arm), task.context.hand)
        if not ways:
            faults.append(f"{arm} hand: {found.target.label!r} is too thin for it, or would tip over")
            continue
        try:
            plan = await robot.plan_grasp(arm, ways, found)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
            faults.append(error.message)
            continue
        return Push(arm, found.target.p_base[:2], end, ways[plan.chosen], plan)
    raise OpenArmError(Code.UNREACHABLE, f"no hand comes behind it: {'; '.join(faults)}")


async def carry_out_push(task: Task, planned: Push, found: Sighting, number: int) -> tuple[Sighting, str]:
    """Push, go home and observe; returns the object as it was observed, and a sentence.

    Args:
        task: That it is a part of.
        planned: The push.
        found: The object and its neighbours before.
        number: Of the push, 1-based.

    Raises:
        OpenArmError: EXECUTION_FAILED or HAND_COLLISION, when the hand did not do it; what observing raises, when the
            object is not seen any more.
    """
    config, robot, arm, way = task.context.config, task.robot, planned.arm, planned.way
    task.note(f"push {number} of at most {config.push.most}: {planned}")
    T_base_back, fault = way.T_base_tcp, None
    try:
        await _go_behind(task, planned)
        p_back = way.retreat_offset - config.push.gap * _direction(way.retreat_offset)
        T_base_back = se3.make(p=p_back) @ way.T_base_tcp
        await robot.follow(arm, planned.plan.retreat, "push")
    except OpenArmError as error:
        fault = error
    if fault is None or fault.code not in STOPS:
        try:
            await _go_home(task, arm, T_base_back)
        except OpenArmError as error:
            fault = fault or error
    if fault is not None:
        raise OpenArmError(fault.code, f"push {number}: {fault.message}")
    try:
        frames = (await robot.observe_in_base(config.detect.frames)).frames
    except OpenArmError as error:
        text = f"push {number}: {found.target.label!r} was not seen since: {error.message}"
        raise OpenArmError(error.code, text) from error
    there = seen_at(found, planned.end)
    pushed = task.request.about(there).find(frames, config.detect)
    x, y = p = pushed.target.p_base[:2]
    moved, off = (float(np.hypot(*(p - q))) for q in (planned.start, planned.end))
    text = (
        f"push {number} by the {arm} hand moved it {moved * 1e3:.0f} mm to ({x:.3f}, {y:.3f}) m, {off * 1e3:.0f} mm"
        " from its destination"
    )
    task.note(text)
    return pushed, text


async def _go_behind(task: Task, planned: Push) -> None:
    """Close the hand and bring it behind the object."""
    arm, robot, T_base_tcp = planned.arm, task.robot, planned.way.T_base_tcp
    what = "move behind the object"
    await robot.follow_and_grip(arm, planned.plan.transfer, what, "close")
    await robot.follow(arm, planned.plan.approach, "move down behind the object")
    error = (await robot.measure(arm, 0.0, T_base_tcp)).tcp_error
    if error > task.context.config.held.max_tcp_error:
        text = f"the {arm} hand stopped {error * 1e3:.0f} mm from its place behind the object"
        raise OpenArmError(Code.HAND_COLLISION, text)


async def _go_home(task: Task, arm: str, T_base_back: Array) -> None:
    """Leave the object the way the hand came, and go home."""
    try:
        await task.robot.move_linear(arm, T_base_back, "leave the object")
    except OpenArmError as error:
        reraise_stop(error)
        task.robot.warn(error.message)  # the free path home may still be there
    await task.robot.go_home((arm,), back_off_below=task.context.clear_of_objects)


def destinations(target: Detection, others: Sequence[Detection], context: GraspContext) -> tuple[Array, ...]:
    """Places around the object, on the table and free of others: short pushes first, then those to the sides.

    Args:
        target: The object.
        others: What else stands on the table.
        context: Parameters and table.
    """
    config, place, table = context.config.push, context.config.place, context.table
    p, half = target.p_base[:2], 0.5 * float(np.hypot(*target.size[:2]))
    found: list[tuple[float, float, float, float]] = []
    for length, k in product(config.lengths, range(config.directions)):
        angle = 2.0 * pi * k / config.directions
        x, y = float(p[0] + length * cos(angle)), float(p[1] + length * sin(angle))
        room = min((hypot(x - d.p_base[0], y - d.p_base[1]) for d in others), default=inf)
        on_table = table.x[0] + half <= x <= table.x[1] - half and table.y[0] + half <= y <= table.y[1] - half
        if on_table and room >= place.neighbour_distance:
            found.append((length, -round(abs(sin(angle)), 3), x, y))
    return tuple(np.array([x, y]) for _, _, x, y in sorted(found))


def push_ways(
    target: Detection, end: Array, config: GraspConfig, hand: Array, measures: HandParts
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
        measures: Of the hand.
    """
    way = np.array([*(end - target.p_base[:2]), 0.0])
    ahead = _direction(way)
    aside = np.cross(UP, ahead)
    half, half_width = (
        0.5 * float(np.abs(target.T_base_object[:3, :2].T @ v) @ target.size[:2]) for v in (ahead, aside)
    )
    tall = float(target.size[2])
    faces = (("ahead+", ahead), ("ahead-", -ahead), ("aside+", aside), ("aside-", -aside))
    found: list[GraspCandidate] = []
    for (name, y_tool), tilt_deg, lean in product(faces, config.push.tilts_deg, (1.0, -1.0)):
        heading = lean * np.cross(UP, y_tool)
        if (tilt_deg == 0.0 and lean < 0.0) or float(heading @ ahead) < -1e-6:
            continue
        tilt = radians(tilt_deg)
        R = se3.rotation_from_z_y(sin(tilt) * heading - cos(tilt) * UP, y_tool)
        height = tips_height(tilt, measures)
        met = _front(hand @ R.T, ahead, half_width, (-height, tall - height))
        if met is None or met[1] + height > 0.5 * tall:
            continue
        front, _ = met
        p = target.p_base - (half + front + config.push.gap) * ahead
        p[2] = target.bottom + height
        found.append(
            GraspCandidate(
                id=f"{target.label}/push/{name}/tilt{tilt_deg:g}" + (f"/lean{lean:+g}" if tilt_deg else ""),
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
    tcp = description.tcp_link(arm)
    palm = description.chain(tcp)[-1].parent
    links = [palm, *(joint.child for joint in description.joints.values() if joint.parent == palm)]
    poses = description.link_poses(dict.fromkeys(description.joints, 0.0))
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
        half_width: Of the object, across that direction, m.
        height: Of the object's lower and upper face above the TCP, m.
    """
    across = np.abs(points @ np.cross(UP, ahead))
    low, high = height
    meets = points[(across <= half_width + _FLAT) & (points[:, 2] > low) & (points[:, 2] < high + _FLAT)]
    if not len(meets):
        return None
    reach = meets @ ahead
    front = float(reach.max())
    return front, float(meets[reach > front - _FLAT, 2].min())


def _direction(v: Array) -> Array:
    return v / np.linalg.norm(v)
