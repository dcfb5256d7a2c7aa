# SPDX-License-Identifier: Apache-2.0
"""Following trajectories of one arm: send them to its controller, watch, and check that the arm arrived.

Robot time is the stamp of the joint states, so a slow or paused simulation does not count as a stuck arm.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_motion.service.robot import RobotInterface, RobotWatch, TrajectoryGoal

if TYPE_CHECKING:
    from openarm_motion.planning.arm import Arm
    from openarm_motion.timing.trajectory import Motion

#: A controller has this long to accept, to refuse, or to end a cancelled motion, s.
_ANSWER = 2.0
#: A controller that is missing for so long is gone, s: discovery may lose it for a moment.
_GONE = 1.0
#: A controller has this long to appear before a motion, s.
_READY = 1.0
#: A controller has this long after it accepted to say when it began, s; else that is when it accepted.
_TOLD = 0.2


@dataclass(frozen=True)
class MotionInProgress:
    """A motion under way, the robot time at which it began, and whether that is certain or a guess."""

    motion: Motion
    since_ns: int
    certain: bool

    def rest(self, now_ns: int) -> Motion:
        """Return what is left of it, beginning now."""
        return self.motion.later((self.since_ns - now_ns) * 1e-9)


@dataclass(eq=False)
class _Execution:
    """One call of `MotionFollower.follow`; `missing` is how long its controller has been missing, s."""

    motion: Motion
    begin_ns: int
    touches: bool
    cancelled: Callable[[], bool]
    progress: Callable[[float], None]
    watch: RobotWatch
    missing: float = 0.0


class MotionFollower:
    """Executes one motion of one arm at a time.

    Args:
        robot: The robot.
        arm: The arm.
    """

    def __init__(self, robot: RobotInterface, arm: Arm) -> None:
        self._robot, self._arm, self._config = robot, arm, arm.config.execution
        self._controller = robot.controller(arm.name)
        self.active: MotionInProgress | None = None

    def begin(self, motion: Motion, begin_ns: int = 0) -> None:
        """Count as under way from a robot time on; 0 is about now."""
        self.active = MotionInProgress(motion, begin_ns or self._robot.states.latest()[0], bool(begin_ns))

    async def follow(
        self,
        motion: Motion,
        begin_ns: int,
        cancelled: Callable[[], bool],
        progress: Callable[[float], None],
        *,
        touches: bool = True,
    ) -> None:
        """Send a trajectory and return when the arm has arrived.

        Args:
            motion: The trajectory.
            begin_ns: Robot time of its beginning; 0: at once.
            cancelled: Whether to stop; the controller then holds.
            progress: Called with 0 to 1 while the arm moves.
            touches: Something is touched where it ends; see `ArmController.start`.

        Raises:
            OpenArmError: NOT_READY, without controller or joint states; ROBOT_LOST, when either vanishes on the way;
                EXECUTION_FAILED, with the controller's reason or the joint that did not arrive; TIMEOUT; CANCELLED.
        """
        run = _Execution(motion, begin_ns, touches, cancelled, progress, RobotWatch(self._robot))
        self.begin(motion, begin_ns)
        try:
            await run.watch.fresh()
            if not await run.watch.until(self._controller.ready, limit=_READY):
                text = f"no controller offers {self._controller.name}; is the bridge or driver running?"
                raise OpenArmError(Code.NOT_READY, text)
            await self._send(run)
            await self._arrive(run)
        finally:
            self.active = None
        progress(1.0)

    async def _send(self, run: _Execution) -> None:
        name, goal = self._controller.name, self._controller.start(run.motion, run.begin_ns, touches=run.touches)
        try:
            if not await run.watch.until(lambda: goal.accepted is not None, lambda: self._check(run), _ANSWER):
                raise OpenArmError(Code.ROBOT_LOST, f"{name} did not answer a goal within {_ANSWER:g} s")
            if not goal.accepted:
                raise OpenArmError(Code.EXECUTION_FAILED, f"{name} rejected the trajectory")
            if not run.begin_ns:
                self.begin(run.motion, goal.since_ns)  # it begins when it is accepted
            stopping = await self._watch_goal(run, goal)
        except OpenArmError:
            goal.cancel()
            raise
        success, text = goal.outcome is not None and goal.outcome.success, goal.outcome.text if goal.outcome else ""
        if stopping and not success:
            raise OpenArmError(Code.CANCELLED, f"cancelled; the {self._arm.name} arm holds where it is")
        if not success:
            code = goal.outcome.code if goal.outcome else Code.EXECUTION_FAILED
            raise OpenArmError(code, f"controller of the {self._arm.name} arm: {text}")
        if stopping and run.cancelled():
            raise OpenArmError(Code.CANCELLED, f"cancelled as the {self._arm.name} arm arrived; it holds there")

    async def _watch_goal(self, run: _Execution, goal: TrajectoryGoal) -> bool:
        """Wait for the end of an accepted goal; return whether it was cancelled here."""
        name, duration = self._controller.name, run.motion.duration
        since: float | None = None
        accepted = self._robot.now()

        def check() -> None:
            nonlocal since
            self._check(run)
            active = self.active
            if active is not None and not active.certain:
                told = goal.since_ns or self._robot.now() - accepted > _TOLD
                active = self.active = replace(active, since_ns=goal.since_ns or active.since_ns, certain=bool(told))
            elapsed = (self._robot.states.latest()[0] - active.since_ns) * 1e-9 if active else 0.0
            run.progress(min(1.0, max(0.0, elapsed / max(duration, 1e-3))))
            if elapsed > duration + self._config.overtime:
                text = f"{name} has not ended {elapsed:.1f} s after a start of {duration:.1f} s"
                raise OpenArmError(Code.TIMEOUT, text)
            if since is None and run.cancelled():
                goal.cancel()
                since = self._robot.now()
            if since is not None and self._robot.now() - since > _ANSWER:
                raise OpenArmError(Code.CANCELLED, f"cancelled, but {name} did not confirm that it holds")

        await run.watch.until(lambda: goal.outcome is not None, check)
        return since is not None

    async def _arrive(self, run: _Execution) -> None:
        """Wait until the joints are where the motion ends; what a controller says is not evidence."""
        states, settle_ns = self._robot.states, self._config.settle * 1e9
        arrived_ns = states.latest()[0]

        def ended() -> bool:
            late = states.latest()[0] - arrived_ns > settle_ns
            return late or run.cancelled() or not self._missed(run.motion)

        await run.watch.until(ended, lambda: self._check(run))
        missed = self._missed(run.motion)
        if missed and run.cancelled():
            raise OpenArmError(Code.CANCELLED, f"cancelled; the {self._arm.name} arm holds where it is")
        if missed:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{missed}; blocked?")

    def _check(self, run: _Execution) -> None:
        """Notice that joint states or the controller vanish during a motion."""
        limit = self._config.stale_after
        if run.watch.silence > limit:
            age = self._robot.state_age()
            raise OpenArmError(Code.ROBOT_LOST, f"no /joint_states for {age:.1f} s, expected one within {limit:g} s")
        run.missing = 0.0 if self._controller.ready() else run.missing + run.watch.awake
        if run.missing > _GONE:
            raise OpenArmError(Code.ROBOT_LOST, f"controller {self._controller.name} is gone")

    def _missed(self, motion: Motion) -> str:
        """How far from its end the arm is, in a sentence; empty when it is there."""
        state = self._robot.states.latest()[1]
        now = np.array([state[name] for name in motion.names])
        errors = np.abs(now - motion.q[-1])
        i, limit = int(np.argmax(errors)), self._config.goal_tolerance
        if errors[i] > limit:
            return f"{motion.names[i]} ended {errors[i]:.3f} rad from its goal, expected within {limit:g}"
        ends = self._arm.kinematics.fk_many(np.array([motion.q[-1], now]))
        distance, limit = float(np.linalg.norm(ends[0, :3, 3] - ends[1, :3, 3])), self._config.tool_tolerance
        if distance > limit:
            return f"the tool ended {distance * 1e3:.1f} mm from its goal, expected within {limit * 1e3:g}"
        return ""
