# SPDX-License-Identifier: Apache-2.0
"""One arm that follows twists and joint velocities. Each set point comes with a stop that was proven to keep clear.

Robot time is ns; everything else SI, rad. Used under one lock; see `openarm_motion.servo.servo`.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.config import ServoingConfig
from openarm_motion.servo.course import Course, JointState
from openarm_motion.servo.twist import condition, joint_velocities
from openarm_motion.timing.trajectory import Motion

if TYPE_CHECKING:
    from openarm_motion.planning.arm import Arm
    from openarm_motion.servo.surroundings import Near, Surroundings

#: A set point is this far ahead of robot time, s: what it takes to arrive; the first one, which meets the arm's sag.
_LEAD, _FIRST_LEAD = 0.012, 0.1
#: A set point is followed for so long, s, where no other comes, and no longer than its command counts; then it stops.
_HOLD = 0.025
#: Set points that are nearer in time are one, s.
_LEAST = 0.002
#: Trajectories are stamped this far in the past, s: their first point is a way point, whatever the clocks say.
_BEFORE = 0.03
#: A share of the speed that keeps clear is searched for so often, from a little more than the last one downwards; less
#: than the least share is none.
_TRIES, _FASTER, _SLOWER, _LEAST_SHARE = 5, 1.25, 0.6, 0.02
#: The same while something is too near already.
_ESCAPES = 3
#: Share of the speed while something is too near already, and least one on the way out of a singular posture.
_ESCAPE, _LEAVING = 0.3, 0.3
#: What the condition number is compared over, s.
_GLANCE = 0.02
#: A fault is over when commands have ceased for so long, s.
_FORGIVEN = 0.3
#: Positions of another arm's course that are checked.
_OTHERS = 5


class ServoState(IntEnum):
    """What servoing does with a command; numbers as in moveit_msgs/ServoStatus."""

    INVALID = -1
    NO_WARNING = 0
    DECELERATE_FOR_APPROACHING_SINGULARITY = 1
    HALT_FOR_SINGULARITY = 2
    DECELERATE_FOR_LEAVING_SINGULARITY = 3
    DECELERATE_FOR_COLLISION = 4
    HALT_FOR_COLLISION = 5
    JOINT_BOUND = 6


@dataclass(frozen=True, eq=False)
class ServoCommand:
    """What is asked: a twist (6,) of the tool in the base frame, or joint velocities (n,); when it came, s."""

    velocity: Array
    at: float
    is_twist: bool


@dataclass(frozen=True)
class ServoReport:
    """What an arm does, and why, in a sentence."""

    status: ServoState = ServoState.NO_WARNING
    text: str = ""


class ArmServo:
    """Servoing of one arm.

    Args:
        arm: The arm.
        config: Parameters.
        follow_tolerance: A joint further than this from its set point does not follow, rad.
    """

    def __init__(self, arm: Arm, config: ServoingConfig, follow_tolerance: float) -> None:
        self.arm, self._config, self._tolerance = arm, config, follow_tolerance
        self._limits = arm.limits(1.0)
        self._command: ServoCommand | None = None
        self._course: Course | None = None
        self._since_ns = 0
        self._set_points: deque[tuple[int, Array]] = deque(maxlen=64)
        self._share = 1.0  # of the speed wanted, that was kept last
        self._hold = _HOLD
        self._fault, self._heard = "", -np.inf
        self.report = ServoReport()

    @property
    def busy(self) -> bool:
        """Whether the arm is commanded or under way."""
        return self._course is not None or self._command is not None

    def take(self, command: ServoCommand) -> None:
        """Follow a command from now on."""
        before = self._command
        if before is None or before.is_twist != command.is_twist or before.velocity @ command.velocity <= 0.0:
            self._share = 1.0  # it goes elsewhere
        if command.at - self._heard > _FORGIVEN:
            self._fault = ""
        self._command, self._heard = command, command.at

    def halt(self) -> None:
        """Come to rest: the command counts no more."""
        self._command = None

    def drop(self) -> None:
        """Send no more set points: the last trajectory ends at rest."""
        self._command = self._course = None

    def ahead(self, now_ns: int) -> Array:
        """Positions (m, n) from a time to the end of the course."""
        if self._course is None:
            return np.empty((0, self.arm.kinematics.n))
        begin = (now_ns - self._since_ns) * 1e-9
        times = np.linspace(min(begin, self._course.duration), self._course.duration, _OTHERS)
        return np.array([self._course.at(max(t, 0.0)).q for t in times])

    def tick(
        self, now_ns: int, wall: float, measured: tuple[int, Array], around: Surroundings, others: Mapping[str, Array]
    ) -> tuple[Motion, int] | None:
        """Find the next set point.

        Args:
            now_ns: Robot time.
            wall: Time of commands, s.
            measured: Stamp and positions (n,) of the newest joint state.
            around: Obstacles to keep clear of.
            others: Positions (m, k) of the other arms, by name.

        Returns:
            A trajectory that ends at rest, and the stamp of its beginning; None: go on with the last one.
        """
        wanted, is_twist = self._wanted(wall)
        if self._set_points:
            measured = measured[0], nearest_turns(measured[1], self._set_points[-1][1], self.arm.upper)
        if self._course is None and wanted is None:
            return None
        lead_ns = round((_LEAD if self._course is not None else _FIRST_LEAD) * 1e9)
        begin_ns = now_ns + lead_ns
        if self._course is not None and begin_ns - self._since_ns < _LEAST * 1e9:
            return None
        if self._course is None:
            course = Course.resting(self._resting_place(measured[1]), self._limits)
            self._course, self._since_ns = course, begin_ns
        start = self._course.at((begin_ns - self._since_ns) * 1e-9)
        if self._lost(measured):
            wanted = None
        if wanted is None or not np.any(wanted):
            chosen = Course.of(start, np.zeros_like(start.q), 0.0, self._limits)
            self._say(ServoReport(ServoState.INVALID, self._fault) if self._fault else ServoReport())
        else:
            chosen = self._chosen(start, wanted, around, others, is_twist=is_twist)
        return self._commit(chosen, begin_ns, now_ns, ended=wanted is None)

    # --- parts of these
    def _wanted(self, wall: float) -> tuple[Array | None, bool]:
        """What is asked now; None: nothing."""
        if self._command is not None and wall - self._command.at > self._config.incoming_command_timeout:
            self._command = None
        command = self._command
        if command is not None:
            self._hold = min(_HOLD, command.at + self._config.incoming_command_timeout - wall)
        return (None, False) if command is None else (command.velocity, command.is_twist)

    def _resting_place(self, measured: Array) -> Array:
        """The last set point; the measured position, when others have moved the arm since."""
        if self._set_points and np.max(np.abs(self._set_points[-1][1] - measured)) < 0.2 * self._tolerance:
            return self._set_points[-1][1]
        return np.clip(measured, self.arm.lower, self.arm.upper)

    def _lost(self, measured: tuple[int, Array]) -> bool:
        """Whether the arm does not follow."""
        stamp_ns, q = measured
        if not self._fault and self._set_points and self._set_points[0][0] <= stamp_ns <= self._set_points[-1][0]:
            times = np.array([t for t, _ in self._set_points])
            k = int(np.searchsorted(times, stamp_ns))
            error = np.abs(q - self._set_points[k][1])
            if k:  # what lies between the two set points is no error
                error = np.minimum(error, np.abs(q - self._set_points[k - 1][1]))
            j = int(np.argmax(error))
            if error[j] > self._tolerance:
                self._fault = (
                    f"{self.arm.names[j]} is {error[j]:.3f} rad from its set point, expected within"
                    f" {self._tolerance:g}: blocked or stopped? Servoing goes on when commands have paused"
                )
                self._command = None
        return bool(self._fault)

    def _commit(self, course: Course, begin_ns: int, now_ns: int, *, ended: bool) -> tuple[Motion, int] | None:
        self._set_points.append((begin_ns, course.start.q))
        self._course, self._since_ns = course, begin_ns
        if course.duration < 1e-6:  # it rests already
            if ended:
                self._course = None
                if self._fault:
                    self._set_points.clear()
            return None
        times = course.times()
        states = [course.at(t) for t in times]
        lead = (begin_ns - now_ns) * 1e-9 + _BEFORE
        t, q, v = times + lead, np.array([s.q for s in states]), np.array([s.v for s in states])
        v[-1] = 0.0
        return Motion(self.arm.names, t, q, v), now_ns - round(_BEFORE * 1e9)

    def _chosen(
        self, start: JointState, wanted: Array, around: Surroundings, others: Mapping[str, Array], *, is_twist: bool
    ) -> Course:
        """The course with the greatest share of what is wanted that stops in time."""
        kinematics, report, velocity, share = self.arm.kinematics, ServoReport(), wanted, 1.0
        if is_twist:
            velocity, now = joint_velocities(kinematics, start.q, wanted)
            share, report = self._for_singularity(now, condition(kinematics, start.q + _GLANCE * velocity))
        fastest = float(np.max(np.abs(velocity) / self._limits.velocity))
        velocity = velocity * share / max(fastest, 1.0)
        if share <= 0.0:
            self._say(report)
            return self._course_of(start, velocity, 0.0)[0]
        here = around.joined({self.arm.name: start.q, **{name: rows[0] for name, rows in others.items()}})
        clear = around.free(here)
        ends = {name: np.unique(rows[[0, -1]], axis=0) for name, rows in others.items()}  # one, where it rests
        near = None if clear else around.near(around.combined(self.arm.name, start.q[None], ends)[:, 0])
        kept, hit, course = 0.0, ServoReport(), self._course_of(start, velocity, 0.0)[0]
        tried = min(self._share * _FASTER + _LEAST_SHARE, 1.0 if clear else _ESCAPE)
        for _ in range(_TRIES if clear else _ESCAPES):
            candidate, further = self._course_of(start, velocity, tried)
            refusal = self._refusal(candidate, further, around, others if near is None else ends, near)
            if refusal is None:
                course, kept = candidate, tried
                break
            hit, tried = refusal, _SLOWER * tried
        self._share = kept
        if kept < _LEAST_SHARE:
            halts = ServoState.HALT_FOR_COLLISION if hit.status is ServoState.DECELERATE_FOR_COLLISION else hit.status
            self._say(ServoReport(halts, hit.text.replace("slows", "stops", 1)))
            return self._course_of(start, velocity, 0.0)[0]
        slowed = hit if hit.text else self.report if kept < 1.0 and "slows" in self.report.text else report
        if not clear and not hit.text:
            slowed = ServoReport(
                ServoState.DECELERATE_FOR_COLLISION, f"the {self.arm.name} arm slows: something is too near"
            )
        self._say(slowed)
        return course

    def _course_of(self, start: JointState, velocity: Array, share: float) -> tuple[Course, Course]:
        """A course, and the same that goes on for longer."""
        longer = _HOLD + self._config.lookahead
        first = Course.of(start, share * velocity, self._hold if share > 0.0 else 0.0, self._limits)
        return first, first if share <= 0.0 else Course.of(start, share * velocity, longer, self._limits)

    def _refusal(
        self,
        course: Course,
        further: Course,
        around: Surroundings,
        others: Mapping[str, Array],
        near: list[Near] | None,
    ) -> ServoReport | None:
        """Why a course may not be followed; None: it may. One that begins too `near` may not come nearer.

        The latter is checked half way and at its end, by the exact layer, which takes 0.8 ms each.
        """
        name = self.arm.name
        if bound := self._bound(course.start.q, further.end):
            return ServoReport(ServoState.JOINT_BOUND, f"the {name} arm slows: {bound}")
        for one in (further, course) if near is None else (course,):
            path = one.positions() if near is None else np.stack([one.at(0.5 * one.duration).q, one.end])
            ways = around.combined(name, path, others)
            if near is None:
                keeps_clear = around.free(np.concatenate(ways))
            else:
                keeps_clear = all(around.no_nearer(way, was) for way, was in zip(ways, near, strict=True))
            if not keeps_clear:
                return ServoReport(
                    ServoState.DECELERATE_FOR_COLLISION, f"the {name} arm slows: {self._what(ways[0], around)}"
                )
        return None

    def _what(self, way: Array, around: Surroundings) -> str:
        """What is in the way, in words; found once, while it is."""
        if "arm slows:" in self.report.text or "arm stops:" in self.report.text:
            return self.report.text.partition(": ")[2]
        contact = around.contact(way[[len(way) // 2, -1]])
        return "something is near" if contact is None else f"{contact.first} is near {contact.second}{contact.where}"

    def _bound(self, before: Array, after: Array) -> str:
        """The joint that comes too near to a limit of its."""
        margin = self._config.joint_limit_margin
        low, high = self.arm.lower + margin, self.arm.upper - margin
        out = np.maximum(low - after, after - high)
        nearer = out > np.maximum(np.maximum(low - before, before - high), 0.0) + 1e-9
        if not nearer.any():
            return ""
        j = int(np.argmax(np.where(nearer, out, -np.inf)))
        limits = f"{self.arm.lower[j]:.3f} to {self.arm.upper[j]:.3f}"
        return f"{self.arm.names[j]} at {before[j]:.3f} rad is near its limits {limits}"

    def _for_singularity(self, now: float, soon: float) -> tuple[float, ServoReport]:
        """Share of the speed near a singular posture, by the condition number now and a moment later."""
        low, high = self._config.lower_singularity_threshold, self._config.hard_stop_singularity_threshold
        if now <= low:
            return 1.0, ServoReport()
        share = max(0.0, (high - now) / (high - low)) if np.isfinite(now) else 0.0
        bounds = f"slow above {low:g}, stop at {high:g}"
        text = f"the {self.arm.name} arm is near a singular posture: condition {now:.0f}; {bounds}"
        if soon <= now:
            return max(share, _LEAVING), ServoReport(ServoState.DECELERATE_FOR_LEAVING_SINGULARITY, text)
        status = ServoState.DECELERATE_FOR_APPROACHING_SINGULARITY if share > 0.0 else ServoState.HALT_FOR_SINGULARITY
        return share, ServoReport(status, text)

    def _say(self, report: ServoReport) -> None:
        self.report = report
