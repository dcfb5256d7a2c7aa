# SPDX-License-Identifier: Apache-2.0
"""What pushes have in common: a line that was planned, the hand that goes along it, and what is seen then. Base frame.

A closed hand goes behind an object, low, and along a straight line; then it goes home, and the camera looks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import islice, product

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.evidence.camera import judge_unmoved
from openarm_grasp.evidence.verdicts import CameraVerdict, HandVerdict, judge_path
from openarm_grasp.perception.detections import Sighting, apart
from openarm_grasp.perception.sightings import first_points, seen_at
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.options import refusals
from openarm_grasp.planning.pushes import closed_hand, direction, push_ways, sweeps
from openarm_grasp.requests.task import Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.robot.skills import STOPS, reraise_stop

#: Lines through a crowd that are planned at most, by arm and length.
_SWEEPS = 5
#: Turns of a hand that meets things of any shape, deg.
_TURNS = (0.0, 30.0, -30.0)
#: What moves by a smaller share of a push than this has not gone along; directions so near (cosine) are the same.
_FOLLOWS, _SAME_WAY = 1.0 / 3.0, 0.5


@dataclass(frozen=True)
class Push:
    """A push that was planned.

    Attributes:
        arm: Arm of the hand.
        start: (2,) where the object stands.
        end: (2,) where it should stand afterwards.
        way: Pose of the hand behind it, and its line.
        plan: The trajectories.
        why: Purpose of the push.
    """

    arm: str
    start: Array
    end: Array
    way: GraspCandidate
    plan: Planned
    why: str

    def __str__(self) -> str:
        """Sentence for the status."""
        (x0, y0), (x1, y1) = self.start, self.end
        return f"the {self.arm} hand pushes it from ({x0:.3f}, {y0:.3f}) to ({x1:.3f}, {y1:.3f}) m, {self.why}"

    @property
    def ahead(self) -> Array:
        """(2,) direction."""
        return direction(self.end - self.start)

    @property
    def least(self) -> float:
        """How far an object moves at least that goes along, and does not stay or slide past the hand, m."""
        return _FOLLOWS * float(np.linalg.norm(self.end - self.start))

    def moves(self, before: Detection, after: Detection) -> bool:
        """Whether the object went along."""
        return apart(before, after) >= self.least


async def plan_sweep(
    task: Task, found: Sighting, avoid: Sequence[Array], lengths: Sequence[float], *, longest: bool = False
) -> Push:
    """Find a line that pushes an object along with what it meets; off what it lies on, where the table leaves no room.

    Args:
        task: Task that it is a part of.
        found: The object and its neighbours.
        avoid: (2,) directions in which a push did not move it, or from which one has.
        lengths: Lengths of its way, m.
        longest: Try the longest first of lines that move as many things, else short ones that lead outwards.

    Raises:
        OpenArmError: UNREACHABLE, with the reason, when there is none; what the robot raises.
    """
    context, robot, faults = task.context, task.robot, list[str]()
    start = found.target.p_base[:2]
    arms, levels = context.arm_order(task.request.arm, float(start[1])), context.config.push.levels
    for level, arm in product(levels, arms):
        hand = closed_hand(robot.description, arm)
        found_lines = sweeps(found, hand, context, lengths, level=level, longest=longest)
        lines = (one for one in found_lines if is_open(one.freed - start, avoid))
        for sweep in islice(lines, _SWEEPS * len(lengths)):
            ways = push_ways(sweep.met, sweep.end, context.config, hand, context.hand, _TURNS)
            if not ways:
                faults.append(f"{arm} hand: what stands there is too thin for it")
                continue
            with refusals(faults):
                plan = await robot.plan_push(arm, ways, replace(found, others=sweep.rest), sweep.heap, sweep.under)
                return Push(arm, start, sweep.freed, ways[plan.chosen], plan, "through what is near it")
    why = f"{faults[0]} ({len(faults) - 1} other lines refused)" if faults else "there is no room around it"
    raise OpenArmError(Code.UNREACHABLE, f"no line pushes it out of what is near it: {why}")


def is_open(way: Array, avoid: Sequence[Array]) -> bool:
    """Whether a way (2,) leads elsewhere than directions to avoid."""
    return all(float(direction(way) @ one) < _SAME_WAY for one in avoid)


async def carry_out_push(
    task: Task, planned: Push, found: Sighting, number: int
) -> tuple[Sighting, str, HandVerdict, CameraVerdict]:
    """Push, go home and observe.

    Args:
        task: Task that it is a part of.
        planned: The push.
        found: The object and its neighbours before.
        number: Number of the push, 1-based.

    Returns:
        The object as it was observed, a sentence, whether the hand has gone as far as what follows it has moved, and
        whether the object has left its place.

    Raises:
        OpenArmError: EXECUTION_FAILED or HAND_COLLISION, when the hand did not do it; what observing raises, when the
            object is not seen any more.
    """
    config, robot, arm, way = task.context.config, task.robot, planned.arm, planned.way
    task.attempts = max(task.attempts, 1)
    task.note(f"push {number} of at most {config.push.most}: {planned}")
    T_base_back, fault, short = way.T_base_tcp, None, ""
    hand = HandVerdict(Code.EXECUTION_FAILED, "the hand did not go")
    try:
        await _go_behind(task, planned)
        start = robot.T_base_tcp(arm)[:3, 3]
        try:
            await robot.follow(arm, planned.plan.retreat, "push")
        except OpenArmError as error:
            if error.code is not Code.EXECUTION_FAILED:
                raise
            short = f"; {error.message}"  # what was pushed has moved all the same: that is observed
        T_base_tcp = robot.T_base_tcp(arm)
        hand = judge_path(start, T_base_tcp[:3, 3], way.retreat_offset, config.push.gap + planned.least)
        T_base_back = se3.make(p=-config.push.gap * direction(way.retreat_offset)) @ T_base_tcp
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
        frames = await robot.look(config.detect.frames)
    except OpenArmError as error:
        text = f"push {number}: {found.target.label!r} was not seen since: {error.message}"
        raise OpenArmError(error.code, text) from error
    there = seen_at(found, planned.end)
    pushed = task.request.about(there).find(frames, config.detect)
    x, y = p = pushed.target.p_base[:2]
    moved, off = (float(np.hypot(*(p - q))) for q in (planned.start, planned.end))
    text = (
        f"push {number} by the {arm} hand moved it {moved * 1e3:.0f} mm to ({x:.3f}, {y:.3f}) m, {off * 1e3:.0f} mm"
        f" from its destination{short}"
    )
    task.note(text)
    still, seen = judge_unmoved(first_points(found), frames)
    return pushed, text, hand, CameraVerdict(Code.PLACE_FAILED if still else Code.OK, seen)


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
