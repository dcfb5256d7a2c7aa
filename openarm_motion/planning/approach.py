# SPDX-License-Identifier: Apache-2.0
"""Choose and plan one of several approaches: free path, straight line to a target, straight line away from it.

For each target every configuration is followed along both lines on its own branch, and kept when limits and clearance
hold all the way; then one search runs from the start to the beginnings of all that were kept. All three parts are timed
and validated before they are returned. What is refused says why. Base frame, m, rad.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene, Contact
from openarm_motion.collision.solids import Box
from openarm_motion.kinematics.chain import IkSolution
from openarm_motion.kinematics.line import Line, line_contact, solve_line
from openarm_motion.planning.arm import Arm, StartState, first_contact, segment_time
from openarm_motion.planning.failure import PlanFailedError, Stage
from openarm_motion.planning.planner import PlannedPath
from openarm_motion.timing.trajectory import Trajectory, joined, resting
from openarm_motion.timing.validation import validate_trajectory


@dataclass(frozen=True, eq=False)
class Target:
    """One way to reach a place with the tool: lines from `pose` + `approach_offset` to `pose` to `retreat_offset`.

    Attributes:
        id: Returned in refusals.
        pose: (4, 4) of the tool.
        approach_offset: (3,) base frame.
        retreat_offset: (3,) base frame.
        score: A higher one is preferred.
    """

    id: str
    pose: Array
    approach_offset: Array
    retreat_offset: Array
    score: float = 0.0


@dataclass(frozen=True, eq=False)
class ApproachRequest:
    """What `plan_approach` is asked.

    Attributes:
        targets: Any of them will do.
        obstacles: Boxes in addition to the robot and the table, base frame.
        attached: Boxes held by the arm, tool frame.
        touchable: Ids of obstacles that the fingers may touch on the straight parts.
        attached_after: The touchable obstacles are carried on the retreat (a grasp).
        detached_after: The held boxes are left behind on the retreat (a place).
        blend: The free path goes on to the target without a stop before the straight line, where that is free.
    """

    targets: tuple[Target, ...]
    obstacles: tuple[Box, ...] = ()
    attached: tuple[Box, ...] = ()
    touchable: frozenset[str] = frozenset()
    attached_after: bool = False
    detached_after: bool = False
    blend: bool = False

    def check(self) -> None:
        """Refuse a request that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, without targets, for an unknown touchable id or numbers that are not finite.
        """
        if not self.targets:
            raise OpenArmError(Code.INVALID_ARGUMENT, "no targets, expected at least one")
        known = {box.id for box in self.obstacles}
        unknown = sorted(self.touchable - known)
        if unknown:
            there = ", ".join(sorted(known)) or "none"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"touchable {', '.join(unknown)} not among the obstacles: {there}"
            )
        if self.attached_after and self.detached_after:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, "attached_after_approach and detached_after_approach exclude each other"
            )
        for target in self.targets:
            numbers = np.concatenate(
                [target.pose.ravel(), target.approach_offset, target.retreat_offset, [target.score]]
            )
            if not np.all(np.isfinite(numbers)):
                raise OpenArmError(Code.INVALID_ARGUMENT, f"target {target.id!r} has numbers that are not finite")

    def by_score(self, step: float) -> Iterator[list[int]]:
        """Indices of targets whose scores are within `step` of the best of their group, best group first."""
        order = sorted(range(len(self.targets)), key=lambda i: -self.targets[i].score)
        while order:
            least = self.targets[order[0]].score - step
            group = [i for i in order if self.targets[i].score >= least]
            yield group
            order = order[len(group) :]


@dataclass(frozen=True)
class Refused:
    """Why a target was not chosen: at which stage, and the pair in the way where there is one."""

    id: str
    code: Code
    message: str
    stage: Stage = "goal"
    contact: Contact | None = None

    @classmethod
    def of(cls, id: str, error: OpenArmError, message: str, stage: Stage = "goal") -> Refused:
        """For an error; `stage` is of one that does not know it."""
        if isinstance(error, PlanFailedError):
            return cls(id, error.code, message, error.stage, error.contact)
        return cls(id, error.code, message, stage)


#: A configuration nearer to a joint limit than this costs more, rad.
_COMFORT = 0.3
#: Targets checked for a start configuration before the search is tried.
_GOALS = 24
#: A line that a free path goes on to is followed in so many straight joint segments or more, none longer than this, m:
#: a few tenths of a millimetre off it.
_LEAST_SEGMENTS, _SEGMENT = 3, 0.03
#: How far a target got, the furthest first.
_CODES = (Code.NO_PLAN, Code.IN_COLLISION, Code.UNREACHABLE)
_STAGES = ("certificate", "search", "line", "goal")


@dataclass(frozen=True, eq=False)
class ApproachPlan:
    """A plan for target number `chosen`.

    Attributes:
        chosen: Index of the target.
        transfer: Free path to the beginning of the approach; blended, it goes on to the target.
        approach: Straight line to the target; blended, a rest there.
        retreat: Straight line away from it.
        refusals: Why others were not chosen.
        held_after: Boxes that the arm holds at the end, tool frame.
        limit_margins: Of each target, how near its best configuration (of the chosen one: that which was planned) comes
            to a joint limit on both lines, rad; NaN for those that were refused or not checked.
    """

    chosen: int
    transfer: Trajectory
    approach: Trajectory
    retreat: Trajectory
    refusals: tuple[Refused, ...]
    held_after: tuple[Box, ...]
    limit_margins: tuple[float, ...]

    @property
    def parts(self) -> tuple[Trajectory, Trajectory, Trajectory]:
        """Free path, approach and retreat."""
        return self.transfer, self.approach, self.retreat


class ApproachFailedError(PlanFailedError):
    """No target could be planned; stage and pair are of the one that got furthest, `refusals` has all reasons."""

    def __init__(self, furthest: Refused, message: str, refusals: tuple[Refused, ...]) -> None:
        super().__init__(furthest.code, message, furthest.stage, furthest.contact)
        self.furthest, self.refusals = furthest, refusals


@dataclass(frozen=True, eq=False)
class _Candidate:
    target: int
    approach: Line
    retreat: Line
    cost: float
    margin: float


def plan_approach(
    arm: Arm,
    now: StartState,
    request: ApproachRequest,
    report: Callable[[str, int], None] = lambda stage, tried: None,
) -> ApproachPlan:
    """Plan one of the targets.

    Targets are checked by score, those that differ by less than `score_step` together; within such a group short
    travel and distance from joint limits decide.

    Args:
        arm: The arm.
        now: The robot's state, where the arm starts, the velocity scale.
        request: Request.
        report: Called with "checking" or "planning" and the number of targets checked so far.

    Raises:
        ApproachFailedError: UNREACHABLE, IN_COLLISION or NO_PLAN, with the reason for each target.
        OpenArmError: INVALID_ARGUMENT, for a request without targets or with an unknown touchable id; IN_COLLISION,
            when the arm starts in collision; CANCELLED.
    """
    request.check()
    end = time.monotonic() + arm.config.planning.time_limit
    checks = _Checks(arm, now, request)
    refusals: list[Refused] = []
    tried = 0
    groups = list(request.by_score(arm.config.planning.score_step))
    for k, group in enumerate(groups):
        candidates: list[_Candidate] = []
        for index in group:
            if now.stopped():
                raise OpenArmError(Code.CANCELLED, "planning was stopped")
            found, refused = checks.candidates(index)
            candidates += found
            if refused is not None:
                refusals.append(refused)
            tried += 1
            report("checking", tried)
        if not candidates:
            continue
        candidates = sorted(candidates, key=lambda c: c.cost)[:_GOALS]
        report("planning", tried)
        left = max(end - time.monotonic(), 0.1)
        plan = checks.planned(candidates, left if k == len(groups) - 1 else 0.5 * left, refusals)
        if plan is not None:
            return plan
    raise _failed(arm, tuple(refusals))


class _Checks:
    """The three surroundings of one request, built once, and what fits into them."""

    def __init__(self, arm: Arm, now: StartState, request: ApproachRequest) -> None:
        self._arm, self._now, self._request = arm, now, request
        # hands grasp open; a hand that holds something keeps its opening until it lets go
        opened = arm.opened
        before = None if request.attached else opened
        scene = partial(arm.scene, now.state, environment=now.environment)
        self.free = scene(request.obstacles, request.attached, gripper=before)
        arm.relax(self.free, now.start)
        straight = partial(scene, straight=True)
        self._approach = straight(request.obstacles, request.attached, request.touchable, gripper=before)
        self._margins = np.full(len(request.targets), np.nan)
        self._carried = [box for box in request.obstacles if box.id in request.touchable]
        if request.attached_after:
            rest = [box for box in request.obstacles if box.id not in request.touchable]
            held = [*request.attached, *self._carried]
            self._retreat = straight(rest, held)
        elif request.detached_after:
            boxes = [*request.obstacles, *request.attached]
            ids = request.touchable | {box.id for box in request.attached}
            self._retreat = straight(boxes, (), ids, gripper=opened)
        else:
            self._retreat = self._approach

    def held_after(self, pose: Array) -> tuple[Box, ...]:
        """Boxes in the tool frame that the arm holds after the retreat."""
        if self._request.detached_after:
            return ()
        if not self._request.attached_after:
            return self._request.attached
        T = se3.inverse(pose)
        return (*self._request.attached, *(Box(box.id, T @ box.T, box.size) for box in self._carried))

    def planned(self, candidates: list[_Candidate], time_limit: float, refusals: list[Refused]) -> ApproachPlan | None:
        """A plan to one of the candidates, or None; why not is added to the refusals.

        Raises:
            OpenArmError: CANCELLED, or anything else that is not for the lack of a plan.
        """
        arm, now, targets = self._arm, self._now, self._request.targets
        end = time.monotonic() + time_limit
        left = list(candidates)
        while left:
            try:
                goals = np.array([candidate.approach.q[0] for candidate in left])
                free = arm.plan_validated(self.free, now, goals, max(end - time.monotonic(), 0.1))
            except OpenArmError as error:
                if error.code not in (Code.NO_PLAN, Code.IN_COLLISION):
                    raise
                ids = dict.fromkeys(targets[c.target].id for c in left)
                refusals += [Refused.of(id, error, error.message, "search") for id in ids]
                return None
            best = left.pop(free.path.goal)
            pose = targets[best.target].pose
            self._arrange(pose)
            # the transfer may end whole turns away from where the lines were solved
            whole = nearest_turns(best.approach.q[0], free.trajectory.q[-1], arm.upper) - best.approach.q[0]
            line, away = (replace(line, q=line.q + whole) for line in (best.approach, best.retreat))
            approach, retreat = (arm.time_line(one, now.scale) for one in (line, away))
            what = "approach"
            try:
                validate_trajectory(self._approach, approach)
                what = "retreat"
                validate_trajectory(self._retreat, retreat)
            except PlanFailedError as error:
                id = targets[best.target].id
                refusals.append(Refused.of(id, error, f"{id}: on the {what}, {error.message}"))
                continue
            held = self.held_after(pose)
            self._margins[best.target] = best.margin
            margins = tuple(self._margins.tolist())
            transfer = free.trajectory
            if self._request.blend:
                transfer = self._blended(free.path, line, joined(transfer, approach))
                approach = resting(arm.names, approach.q[-1], arm.config.planning.period)
            return ApproachPlan(best.target, transfer, approach, retreat, tuple(refusals), held, margins)
        return None

    def _blended(self, path: PlannedPath, line: Line, stopping: Trajectory) -> Trajectory:
        """A free path and a line without a stop between them, where that is free and faster than the one that stops.

        The line is followed in straight joint segments; the corner before it takes no more of it than the first one.
        """
        arm, before = self._arm, len(path.waypoints)
        count = max(_LEAST_SEGMENTS, int(np.ceil(line.s[-1] / _SEGMENT)))
        at = np.linspace(0, len(line.q) - 1, count + 1).round().astype(int)[1:]
        timing, left = arm.timing_into(path, line.q[at], line.s[at], self._now.scale), True
        while left:
            found = timing.trajectory()
            if found.duration >= stopping.duration:
                break
            found, end = found.of(arm.names), len(found.t) - 1
            k = min(int(np.searchsorted(found.t, timing.moments[before - 1])), end)
            try:
                validate_trajectory(self.free, found.between(0, k))
                validate_trajectory(self._approach, found.between(k, end))
            except PlanFailedError as error:
                left = timing.round_less(error.at)
            else:
                return found
        return stopping

    def candidates(self, index: int) -> tuple[list[_Candidate], Refused | None]:
        """The best configurations for a target, or why there is none."""
        arm, target = self._arm, self._request.targets[index]
        planning = arm.config.planning
        solutions = arm.inverse.solutions(target.pose, planning.joint_margin, self._now.start)
        if not solutions:
            why = arm.inverse.why_not(target.pose, planning.joint_margin, self._now.start)
            return [], Refused(target.id, Code.UNREACHABLE, f"{target.id}: {why}")
        self._arrange(target.pose)
        limits = arm.limits(self._now.scale)
        ordered = sorted(solutions, key=lambda s: self._cost(s, segment_time(self._now.start, s.q, limits)))
        kept: list[_Candidate] = []
        faults: list[PlanFailedError] = []
        for solution in ordered:
            try:
                approach, retreat = self._lines(target, solution)
            except PlanFailedError as error:
                faults.append(error.settled())
                continue
            travel = segment_time(self._now.start, approach.q[0], limits)
            closest = arm.kinematics.margin(np.vstack([approach.q, retreat.q]))
            kept.append(_Candidate(index, approach, retreat, self._cost(solution, travel), closest))
            if len(kept) == planning.keep:
                break
        if kept:
            self._margins[index] = min(kept, key=lambda c: c.cost).margin
            return kept, None
        worst = min(faults, key=_far)
        text = f"{target.id}: {worst.message} ({len(faults)} configurations tried)"
        return [], Refused.of(target.id, worst, text)

    def _lines(self, target: Target, solution: IkSolution) -> tuple[Line, Line]:
        """Both lines of a configuration at the target, free of collision.

        Raises:
            PlanFailedError: UNREACHABLE or IN_COLLISION.
        """
        arm = self._arm
        margin = arm.config.planning.joint_margin
        _require(self._approach, solution.q, "at the target")
        there = target.pose
        away, back = there.copy(), there.copy()
        back[:3, 3] += target.approach_offset
        away[:3, 3] += target.retreat_offset
        try:
            approach = solve_line(arm.inverse, solution, there, back, margin).reversed()
            retreat = solve_line(arm.inverse, solution, there, away, margin)
        except OpenArmError as error:
            raise PlanFailedError(error.code, error.message, "line") from error
        for scene, line, what in ((self._approach, approach, "approach"), (self._retreat, retreat, "retreat")):
            contact = line_contact(scene, line)
            if contact is not None:
                raise PlanFailedError(Code.IN_COLLISION, f"on the {what} {contact}", "line", contact)
        _require(self.free, approach.q[0], "before the approach")
        return approach, retreat

    def _arrange(self, pose: Array) -> None:
        """Put boxes and fingers of the retreat where they are when the tool was at `pose`."""
        if self._request.attached_after:
            for box in self.held_after(pose):
                self._retreat.place(box.id, box.T)
            self._retreat.set_state(self._arm.with_gripper(self._now.state, self._opening(pose)))
        elif self._request.detached_after:
            for box in self._request.attached:
                self._retreat.place(box.id, pose @ box.T)

    def _cost(self, solution: IkSolution, travel: float) -> float:
        """Seconds of travel, and up to one more for a configuration near to a joint limit."""
        return travel + 1.0 - min(self._arm.kinematics.margin(solution.q), _COMFORT) / _COMFORT

    def _opening(self, pose: Array) -> float | None:
        """Finger around what is carried, m: half its extent along the opening axis, the tool's y."""
        extents = [float(np.abs(box.T[:3, :3].T @ pose[:3, 1]) @ box.size) for box in self._carried]
        opened = self._arm.opened
        return None if opened is None else min(opened, 0.5 * max(extents, default=0.0))


def _require(scene: CollisionScene, q: Array, where: str) -> None:
    contact = first_contact(scene, q)
    if contact is not None:
        raise PlanFailedError(Code.IN_COLLISION, f"{where} {contact}", "goal", contact)


def _far(fault: PlanFailedError | Refused) -> tuple[int, int]:
    """Less is further: a collision got further than a line that can't be followed, so it says more."""
    return _CODES.index(fault.code), _STAGES.index(fault.stage)


def _failed(arm: Arm, refusals: tuple[Refused, ...]) -> ApproachFailedError:
    """The furthest that any target got is the code; its message represents the others."""
    furthest = min(refusals, key=_far)
    ids = {refused.id for refused in refusals}
    others = f" ({len(ids) - 1} other targets refused)" if len(ids) > 1 else ""
    return ApproachFailedError(furthest, f"{arm.name} arm: {furthest.message}{others}", refusals)
