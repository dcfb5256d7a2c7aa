# SPDX-License-Identifier: Apache-2.0
"""The performer's link to a robot in this process: planner and controllers are called, time passes in ticks."""

from __future__ import annotations

import time
from collections.abc import Awaitable, Callable, Coroutine, Generator, Mapping, Sequence
from copy import copy
from typing import Any, TypeVar

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.types import Array
from openarm_evaluation.campaign.planner import arms_behind, boxes_of, request_of
from openarm_evaluation.campaign.robot import SimRobot
from openarm_evaluation.campaign.traffic import Traffic
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.evidence import Verdict
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.strategy import effects
from openarm_grasp.strategy.effects import Frames, GoHome, Planned
from openarm_grasp.strategy.link import check_deadline
from openarm_motion.collision.collision import Box
from openarm_motion.planning import moves
from openarm_motion.planning.approach import ApproachFailedError, Refused, plan_approach
from openarm_motion.planning.arm import Arm, Situation
from openarm_motion.scene.memory import HeldMemory
from openarm_motion.timing.checks import Motion, check_trajectory
from openarm_motion.timing.trajectory import Trajectory
from openarm_sim_bridge.control.arm import End, TrajectoryOutcome
from openarm_sim_bridge.control.gripper import GripperGoal, GripperOutcome
from openarm_sim_bridge.control.trajectory import Trajectory as FollowedTrajectory
from openarm_sim_bridge.world.touch import pad_links

T = TypeVar("T")

#: Simulated time that a plan takes, s: a robot's world goes on while it thinks.
PLANNING_S = 0.1


class _Turn:
    """Awaited by coroutines of this link: gives one control tick."""

    def __await__(self) -> Generator[None, None, None]:
        yield


class DirectLink:
    """Implements `openarm_grasp.strategy.link.Link`.

    Args:
        robot: The robot.
        config: Parameters of the grasp.
    """

    def __init__(self, robot: SimRobot, config: GraspConfig) -> None:
        self.robot = robot
        self._config = config
        table = robot.scene.table
        self._arms = arms_behind(table.top_z, table.centre, table.extents)
        self._held = HeldMemory()
        self._traffic = Traffic(self._arms)
        self.planning_s: list[float] = []
        self.warnings: list[str] = []
        self.cancelled = ""
        self.deadline_ns = 0
        #: Longest rest before a motion until the other arm leaves room, s; 0: both never move at once.
        self.max_wait = 0.0
        #: So many plans find no way, on purpose.
        self.plans_to_fail = 0
        #: Called after each tick; what it raises ends what is waited for.
        self.watch: Callable[[], None] = lambda: None

    def beside(self, max_wait: float) -> DirectLink:
        """Another link to the same robot, for an arm that moves while another does."""
        link = copy(self)
        link.max_wait = max_wait
        return link

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Carry out a coroutine of this link, one tick a turn."""
        while True:
            try:
                work.send(None)
            except StopIteration as end:
                return end.value
            self.robot.tick()

    # --- the robot
    @property
    def description(self) -> RobotDescription:
        """The robot."""
        return self.robot.description

    @property
    def states(self) -> RobotStateBuffer:
        """Its joint states."""
        return self.robot.states

    @property
    def base_frame(self) -> str:
        """Name of the base frame."""
        return self.robot.description.root

    @property
    def now_ns(self) -> int:
        """Stamp of the newest joint state."""
        return self.robot.states.latest()[0]

    def effort(self, joint: str) -> float:
        """Newest effort of a joint, N or N m."""
        return self.robot.efforts.get(joint, 0.0)

    def pads(self, arm: str) -> tuple[float, ...]:
        """Force on each finger pad of a hand, N, from its sensors."""
        links = pad_links("left" if arm == "left" else "right")
        return tuple(float(np.linalg.norm(self.robot.world.pad_wrench(link)[0])) for link in links)

    def check(self) -> None:
        """Raise when the grasp shall not go on: CANCELLED, ROBOT_LOST."""
        self.watch()
        if self.cancelled:
            raise OpenArmError(Code.CANCELLED, self.cancelled)
        check_deadline(self.now_ns, self.deadline_ns)
        if self.robot.silent_s > self._config.limits.joint_state_timeout:
            raise OpenArmError(Code.ROBOT_LOST, f"joint states have been silent for {self.robot.silent_s:.1f} s")

    def warn(self, text: str) -> None:
        """Keep a warning for the report."""
        self.warnings.append(text)

    # --- waiting and looking
    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition, `limit` s of simulated time."""
        deadline_ns = self.robot.t_ns + round(limit * 1e9)
        while not done():
            self.check()
            if guard is not None:
                guard()
            if self.robot.t_ns > deadline_ns:
                raise OpenArmError(Code.TIMEOUT, f"{what}: not done within {limit:g} s")
            await _Turn()

    async def together(self, parts: Sequence[Callable[[], Awaitable[None]]]) -> None:
        """Carry out several things at once."""
        left = [part().__await__() for part in parts]
        faults: list[Exception] = []
        while True:
            for work in list(left):
                try:
                    next(work)
                except StopIteration:
                    left.remove(work)
                except OpenArmError as error:
                    left.remove(work)
                    faults.append(error)
            if not left:
                break
            await _Turn()
        if faults:
            raise faults[0]

    async def observe(self, count: int, *, near: bool = False) -> Frames:
        """Frames that are taken from now on.

        Raises:
            OpenArmError: STALE_DATA, when they do not come; CANCELLED; ROBOT_LOST.
        """
        since_ns, robot = self.now_ns, self.robot
        config = self._config
        robot.look(config.near.camera if near else config.camera)
        robot.frames.clear()
        limit = config.near.timeout if near else config.detect.frame_timeout

        def fresh() -> list[Any]:
            return [frame for frame in robot.frames if frame.t_ns >= since_ns]

        try:
            await self.until(lambda: len(fresh()) >= count, limit, "looking")
        except OpenArmError as error:
            if error.code is not Code.TIMEOUT:
                raise
            seen = f"{len(fresh())} of {count} frames came within {limit:g} s"
            raise OpenArmError(Code.STALE_DATA, f"{seen}; are camera and detector running?") from error
        return Frames(tuple(fresh()[-count:]), self.base_frame)

    def stop_looking(self) -> None:
        """Nothing is detected for now."""
        self.robot.look("")

    # --- planning
    async def plan(self, effect: effects.PlanGrasp | effects.PlanPlace) -> Planned:
        """Plan in this thread; a constant time passes for the robot.

        Raises:
            OpenArmError: With the planner's code.
        """
        arm, request = self._arms[effect.arm], request_of(effect)
        after = effect.after if isinstance(effect, effects.PlanPlace) else None
        start = after.q[-1] if isinstance(after, Trajectory) else ()
        now = self._situation(arm, start)
        began = time.perf_counter()
        try:
            if self.plans_to_fail > 0:
                self.plans_to_fail -= 1
                raise OpenArmError(Code.NO_PLAN, f"{arm.name} arm: no path, on purpose")
            plan = plan_approach(arm, now, request)
        except ApproachFailedError as error:
            raise NoWayError(error.code, error.message, _verdicts(error.refusals)) from error
        finally:
            self.planning_s.append(time.perf_counter() - began)
            await self.pass_time(PLANNING_S)
        self._held.expect(arm.name, (plan.transfer, plan.approach), request.attached)
        self._held.expect(arm.name, (plan.retreat,), plan.held_after)
        return Planned(
            plan.chosen,
            plan.transfer,
            plan.approach,
            plan.retreat,
            self.planning_s[-1],
            _verdicts(plan.refusals),
            plan.limit_margins,
        )

    async def reach(self, arm: str, T_base_tcp: Array) -> Mapping[str, float]:
        """How far the arm's TCP stays from a point, in any orientation."""
        solver = self._arms[arm]
        best = solver.inverse.nearest(T_base_tcp, self._situation(solver).start, position_only=True)
        return {arm: float(best.position_error)}

    def _situation(self, arm: Arm, start: Sequence[float] | Array = ()) -> Situation:
        state = self._traffic.arrived(arm.name, self.robot.states.latest()[1])
        return arm.situation(state, list(start), self._config.velocity_scale)

    async def pass_time(self, seconds: float) -> None:
        """Let simulated time pass."""
        end_ns = self.robot.t_ns + round(seconds * 1e9)
        while self.robot.t_ns < end_ns:
            await _Turn()

    # --- moving
    async def follow(
        self, arm: str, trajectory: effects.Trajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Follow a planned trajectory and see that the arm has arrived.

        Raises:
            OpenArmError: As /motion/execute; CANCELLED; ROBOT_LOST; from `guard`.
        """
        if not isinstance(trajectory, Trajectory):
            raise OpenArmError(Code.INTERNAL, f"{type(trajectory).__name__} is no trajectory of the planner")
        try:
            await self._follow(self._arms[arm], trajectory, what, guard)
        except OpenArmError as error:
            if error.code in (Code.CANCELLED, Code.ROBOT_LOST, Code.GRASP_LOST):
                raise
            raise OpenArmError(error.code, f"{what}: {error.message}") from error

    async def _follow(self, arm: Arm, plan: Trajectory, what: str, guard: Callable[[], None] | None) -> None:
        robot, state = self.robot, self.robot.states.latest()[1]
        motion = check_trajectory(arm, Motion.of(plan), state)
        expected, known = self._held.expected(arm.name, motion), self._held.held
        boxes = {**known, arm.name: known.get(arm.name, ()) if expected is None else expected}
        wait = self._traffic.room(arm, motion, robot.t_ns, state, boxes, self.max_wait)
        if expected is not None:
            self._hold(arm, expected)
        follower = robot.controller.arms[arm.name]
        ends: list[TrajectoryOutcome] = []
        start_ns = robot.t_ns + round(wait * 1e9)
        self._traffic.enter(arm.name, motion, start_ns)
        try:
            await self.until(lambda: robot.t_ns >= start_ns, wait + 1.0, what, guard)
            checked = follower.check(FollowedTrajectory(tuple(plan.names), plan.t, plan.q, plan.v, plan.a))
            measured = robot.world.read_joints().position[robot.columns(arm.names)]
            follower.start(checked, robot.t_ns, measured, ends.append)
            limit = motion.duration + arm.config.execution.overtime
            await self.until(lambda: bool(ends), limit, what, lambda: self._traffic.look_out(arm.name, guard))
        except OpenArmError:
            follower.cancel()
            for _ in range(100 if robot.t_ns > start_ns else 0):
                if ends:
                    break
                await _Turn()
            raise
        finally:
            arrived = bool(ends) and ends[0].end is End.SUCCEEDED
            self._traffic.leave(arm.name, robot.t_ns, robot.states.latest()[1], arrived=arrived)
        if ends[0].end is not End.SUCCEEDED:
            raise OpenArmError(Code.EXECUTION_FAILED, f"controller of the {arm.name} arm: {ends[0].text}")

    async def move_linear(self, effect: effects.MoveLinear, what: str) -> None:
        """Move the TCP on a straight line."""
        arm = self._arms[effect.arm]
        await self._move(arm, lambda now: moves.to_pose_on_line(arm, now, effect.T_base_tcp, moves.Around()), what)

    async def move_named(self, arm: str, named: str, effect: GoHome, what: str) -> None:
        """Move an arm on a free path to a posture."""
        solver, around = self._arms[arm], moves.Around(boxes_of(effect.obstacles))
        await self._move(solver, lambda now: moves.to_named(solver, now, named, around), what)

    async def _move(self, arm: Arm, plan: Callable[[Situation], Trajectory], what: str) -> None:
        try:
            trajectory = plan(self._situation(arm))
        except OpenArmError as error:
            raise OpenArmError(error.code, f"{what}: {error.message}") from error
        self._hold(arm, ())
        await self.pass_time(PLANNING_S)
        await self.follow(arm.name, trajectory, what)

    def _hold(self, arm: Arm, boxes: Sequence[Box]) -> None:
        """Note what an arm holds, as the motion node does, for those who look at it."""
        if self._held.hold(arm.name, boxes):
            by_link = ((self._arms[name].kinematics.tool_link, held) for name, held in self._held.held.items())
            self.robot.held = tuple(HeldBox(b.id, link, b.T, tuple(b.size)) for link, held in by_link for b in held)

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        """Move the fingers; whether they arrived or push against something."""
        robot = self.robot
        follower = robot.controller.grippers[arm]
        state, column = robot.world.read_joints(), robot.columns([joint])[0]
        ends: list[GripperOutcome] = []
        goal = follower.check(GripperGoal(position, effort))
        follower.start(goal, float(state.position[column]), float(state.effort[column]), ends.append)
        try:
            await self.until(lambda: bool(ends), self._config.limits.gripper_timeout, what)
        except OpenArmError:
            follower.cancel()
            raise
        return ends[0].stalled or ends[0].reached_goal


def _verdicts(refusals: Sequence[Refused]) -> dict[str, Verdict]:
    return {refused.id: Verdict(refused.code, refused.message) for refused in refusals}
