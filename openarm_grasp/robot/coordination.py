# SPDX-License-Identifier: Apache-2.0
"""Coordination of two arms that work at the same time: they observe in turn, and one waits for the other to leave.

That two arms in motion keep their clearance is validated by motion, which delays the later one. An arm plans when the
other has begun what it has planned, so that each plan knows of all that moves. What is left is an arm at rest in the
way: the other waits until it has gone on. Of two that wait for each other, the one that comes second in the order of
arms gives up, and goes home as after every failure. An arm at work is left alone; another may be sent home. Base frame,
m, rad.
"""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar, cast

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, RobotInterface, Trajectory
from openarm_grasp.robot.skills import Skills

T = TypeVar("T")

#: An arm that has turned a joint so far has begun a motion, or has gone on, rad.
_BEGUN, _GONE_ON = 0.02, 0.1


@dataclass
class ArmCoordination:
    """What the robots of both arms share.

    Attributes:
        at_work: Work of each arm, by arm; others rest.
        waiting: Arms that wait until the other goes on.
        observing: The arm that observes; "" when none does.
        seen: Newest frames of the camera over the table, by the arm that observed.
        sent_home: The arm at rest that the other sends home; "" when none is.
        planned: Joints (n,) at which each arm plans, or has planned, what it may not follow yet, rad by arm.
    """

    at_work: dict[str, str] = field(default_factory=dict[str, str])
    waiting: set[str] = field(default_factory=set[str])
    observing: str = ""
    seen: dict[str, tuple[Frame, ...]] = field(default_factory=dict[str, tuple[Frame, ...]])
    sent_home: str = ""
    planned: dict[str, Array] = field(default_factory=dict[str, Array])

    @contextmanager
    def taking(self, arms: Sequence[str], what: str) -> Generator[None, None, None]:
        """Let arms be at work on something for as long as this is open.

        Raises:
            OpenArmError: BUSY, naming what one of them is at work on.
        """
        if busy := {self.at_work[arm]: None for arm in arms if arm in self.at_work}:
            text = f"{' and '.join(busy)} is running; cancel it or wait until it has ended"
            raise OpenArmError(Code.BUSY, text)
        self.at_work.update(dict.fromkeys(arms, what))
        try:
            yield
        finally:
            for arm in arms:
                self.at_work.pop(arm, None)
                self.planned.pop(arm, None)


class CoordinatedRobot:
    """Implements the robot's interface for one request of one arm while the other may work, too; use `coordinated`.

    Args:
        arm: Arm of this robot.
        robot: The robot, for this arm alone.
        coordination: Shared with the other arm's.
        config: Parameters.
    """

    def __init__(self, arm: str, robot: RobotInterface, coordination: ArmCoordination, config: GraspConfig) -> None:
        self.arm = arm
        self._robot, self._coordination, self._config = robot, coordination, config
        self._other = next(name for name in robot.description.arm_names if name != arm)
        self._homes = {a: robot.description.group_state(f"{a}_arm", config.home_state) for a in (arm, self._other)}
        self.deadline_ns, self.velocity_scale = 0, robot.velocity_scale
        self._begun = self._observed = False

    def __getattr__(self, name: str) -> Any:
        """What is the same for an arm alone."""
        return getattr(self._robot, name)

    def check(self) -> None:
        """Raise when the work may not go on."""
        self._robot.deadline_ns, self._robot.velocity_scale = self.deadline_ns, self.velocity_scale
        self._robot.check()

    def warn(self, text: str) -> None:
        """Report something that does not stop the work."""
        self._robot.warn(f"{self.arm} arm: {text}")

    # --- observing
    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        """Frames that are taken from now on; for a request that begins, those with which the arm's last one ended.

        What the other arm hides may not be needed. An arm that observes from home again without a motion in between
        waits until the other one hides nothing any more.
        """
        coordination, limit, robot = self._coordination, self._config.limits.beside_timeout, self._robot
        coordination.planned.pop(self.arm, None)
        begins, self._begun = not self._begun, True
        again, self._observed = self._observed, self._observed or not near
        known = coordination.seen.get(self.arm, ())[-count:]
        recent = len(known) == count and robot.now_ns - known[-1].t_ns <= self._config.detect.max_age * 1e9
        if begins and not near and recent:
            return known
        if again and not near and self._is_home(self.arm):
            await robot.until(self._other_is_away, limit, f"observing: the {self._other} arm is in the view")
        await robot.until(lambda: coordination.observing in ("", self.arm), limit, "observing: the other arm observes")
        coordination.observing = self.arm
        try:
            seen = await robot.observe(count, near=near)
        finally:
            coordination.observing = ""
            robot.stop_observing()
        if not near:
            coordination.seen[self.arm] = seen
        return seen

    def expect_near(self, camera: str) -> None:
        """Announce an observation by the camera on the hand."""
        self._robot.expect_near(camera)

    def stop_observing(self) -> None:
        """An observation ends by itself."""

    # --- planning and moving
    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        """Plan; again when the other arm has gone on."""

        async def work() -> Planned:
            return await self._robot.plan(request)

        later = isinstance(request, PlanPlace) and request.after is not None
        return await self._patiently(work if later else lambda: self._in_turn(work), "planning")

    async def follow(
        self, arm: str, trajectory: Trajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Follow a planned trajectory, when the other arm leaves clearance for it."""
        self._observed = False
        await self._patiently(lambda: self._robot.follow(arm, trajectory, what, guard), what)
        self._coordination.planned.pop(self.arm, None)

    async def move(
        self, arm: str, to: str | Array, what: str, obstacles: Sequence[Box] = (), *, plan_only: bool = False
    ) -> None:
        """Move an arm to a named posture, or its TCP to a pose; the other arm only when it rests, if it can."""
        coordination = self._coordination

        async def work() -> None:
            await self._robot.move(arm, to, what, obstacles, plan_only=plan_only)

        if arm != self._other:
            self._observed = False
            await self._robot.until(lambda: coordination.sent_home != arm, self._config.limits.beside_timeout, what)
            await self._patiently(work, what)
            return
        if arm in coordination.at_work:
            return
        coordination.sent_home = arm
        try:
            await work()
        except OpenArmError as error:
            self.check()
            self.warn(f"{error.message}; the {arm} arm stays where it is")
        finally:
            coordination.sent_home = ""

    # --- the other arm
    async def _in_turn(self, work: Callable[[], Awaitable[T]]) -> T:
        """Plan when the other arm has begun what it has planned, or has rested as long as it may."""
        planned, limit = self._coordination.planned, self._config.limits.beside_wait

        def begun() -> bool:
            return self._other not in planned or self._has_turned(planned[self._other], _BEGUN)

        try:
            await self._robot.until(begun, limit, f"the {self._other} arm is about to move")
        except OpenArmError as error:
            if error.code is not Code.TIMEOUT:
                raise
        planned[self.arm] = self._pose(self.arm)
        return await work()

    async def _patiently(self, work: Callable[[], Awaitable[T]], what: str) -> T:
        end_ns = self._robot.now_ns + round(self._config.limits.beside_timeout * 1e9)
        while True:
            try:
                return await work()
            except OpenArmError as error:
                self._coordination.planned.pop(self.arm, None)
                if not self._in_the_way(error) or self._robot.now_ns > end_ns:
                    raise
                if not await self._gone_on(what):
                    raise

    def _in_the_way(self, error: OpenArmError) -> bool:
        """Whether it may be the other arm that is in the way; what is refused for other things alone says so."""
        if error.code not in (Code.IN_COLLISION, Code.NO_PLAN) or self._other_is_away():
            return False
        if error.code is Code.NO_PLAN or not isinstance(error, NoWayError):
            return True
        links = {*self._robot.description.links_of(self._other)}
        return any(links.intersection(refusal.bodies) for refusal in error.refusals.values())

    async def _gone_on(self, what: str) -> bool:
        """Wait until the other arm has gone on; false when it waits for this one, and this one is to give way."""
        coordination, before = self._coordination, self._pose(self._other)
        gives_way = self._robot.description.arm_names.index(self.arm) > 0

        def over() -> bool:
            return (
                self._has_turned(before, _GONE_ON)
                or self._other_is_away()
                or (gives_way and self._other in coordination.waiting)
            )

        coordination.waiting.add(self.arm)
        try:
            text = f"{what}: the {self._other} arm is in the way"
            await self._robot.until(over, self._config.limits.beside_timeout, text)
        finally:
            coordination.waiting.discard(self.arm)
        return not (gives_way and self._other in coordination.waiting)

    def _has_turned(self, before: Array, by: float) -> bool:
        """Whether the other arm has turned a joint so far since."""
        return float(np.max(np.abs(self._pose(self._other) - before))) > by

    def _pose(self, arm: str) -> Array:
        _, q = self._robot.states.latest()
        return np.array([q[name] for name in self._homes[arm]])

    def _is_home(self, arm: str) -> bool:
        _, q = self._robot.states.latest()
        return self._robot.description.away(self._homes[arm], q) <= self._config.home_tolerance

    def _other_is_away(self) -> bool:
        return self._other not in self._coordination.at_work or self._is_home(self._other)


def coordinated(arm: str, robot: RobotInterface, coordination: ArmCoordination, config: GraspConfig) -> Skills:
    """The skills of a robot for a request of one arm, `CoordinatedRobot`."""
    return Skills(cast("RobotInterface", CoordinatedRobot(arm, robot, coordination, config)), config)
