# SPDX-License-Identifier: Apache-2.0
"""The robot of the grasp in this process: motion service and controllers are called directly, time is ticks."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from copy import copy
from typing import Any, TypeVar

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_control.gripper import GripperGoal, GripperOutcome
from openarm_evaluation.campaign.robot import SimRobot
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.candidates import Box as GraspBox
from openarm_grasp.planning.options import NoWayError, Refusal
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace, check_deadline, slowed
from openarm_grasp.robot.interface import Trajectory as AnyTrajectory
from openarm_motion.collision.solids import Box
from openarm_motion.planning.approach import ApproachRequest, Target
from openarm_motion.service.requests import (
    ExecuteRequest,
    JointGoal,
    LineGoal,
    MotionAnswer,
    MoveRequest,
    NamedGoal,
    PlanApproachRequest,
)
from openarm_motion.timing.trajectory import Trajectory

T = TypeVar("T")
AnswerT = TypeVar("AnswerT", bound=MotionAnswer)


class InProcessRobot:
    """Implements `openarm_grasp.robot.interface.RobotInterface`.

    Args:
        robot: The robot.
        config: Parameters of the grasp.
    """

    def __init__(self, robot: SimRobot, config: GraspConfig) -> None:
        self.robot = robot
        self.description, self.states = robot.description, robot.states
        self.together = robot.together
        self._config = config
        self.cancelled = ""
        self.deadline_ns, self.velocity_scale = 0, config.velocity_scale
        #: Longest start delay of a motion until the other arm leaves clearance, s; 0: the arms never move at once.
        self.max_start_delay = 0.0
        #: Called after each tick; what it raises ends what is waited for.
        self.watch: Callable[[], None] = lambda: None

    def next_to_other(self) -> InProcessRobot:
        """The same for an arm that moves while the other does: its motions may start later, its deadline is its own."""
        robot = copy(self)
        robot.max_start_delay = self._config.limits.beside_wait
        return robot

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        """Carry out a coroutine of this robot, one tick a turn."""
        while True:
            try:
                work.send(None)
            except StopIteration as end:
                return end.value
            self.robot.tick()

    # --- the robot
    @property
    def now_ns(self) -> int:
        """Stamp of the newest joint state."""
        return self.states.latest()[0]

    def effort(self, joint: str) -> float:
        """Newest effort of a joint, N or N m."""
        return self.robot.efforts.get(joint, 0.0)

    def pads(self, arm: str) -> tuple[float, ...]:
        """Force on each finger pad of a hand, N, from its sensors."""
        links = self.description.arm(arm).fingers
        return tuple(float(np.linalg.norm(self.robot.world.pad_wrench(link)[0])) for link in links)

    def held_box(self, arm: str) -> GraspBox | None:
        """What the motion service carries in a hand, TCP frame."""
        held = self.robot.motion.memory.held.get(arm, ())
        return GraspBox(held[0].id, held[0].T, np.array(held[0].size)) if len(held) == 1 else None

    def check(self) -> None:
        """Raise when the grasp must not go on: CANCELLED, ROBOT_LOST."""
        self.watch()
        if self.cancelled:
            raise OpenArmError(Code.CANCELLED, self.cancelled)
        check_deadline(self.now_ns, self.deadline_ns)
        silent_s = self.robot.state_age()
        if silent_s > self._config.limits.joint_state_timeout:
            raise OpenArmError(Code.ROBOT_LOST, f"joint states have been silent for {silent_s:.1f} s")

    def warn(self, text: str) -> None:
        """Drop it: a row has no place for warnings."""

    # --- waiting and observing
    async def until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Wait for a condition, `limit` s of simulated time."""
        deadline_ns = self.robot.t_ns + limit * 1e9
        while not done():
            self.check()
            if guard is not None:
                guard()
            if self.robot.t_ns > deadline_ns:
                raise OpenArmError(Code.TIMEOUT, f"{what}: not done within {limit:g} s")
            await self.robot.pause()

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        """Frames that are taken from now on.

        Raises:
            OpenArmError: STALE_DATA, when they do not come; CANCELLED; ROBOT_LOST.
        """
        since_ns, robot = self.now_ns, self.robot
        config = self._config
        robot.observe(near or config.camera)
        robot.frames.clear()
        limit = config.near.timeout if near else config.detect.frame_timeout

        def fresh() -> list[Frame]:
            return [frame for frame in robot.frames if frame.t_ns >= since_ns]

        try:
            await self.until(lambda: len(fresh()) >= count, limit, "observing")
        except OpenArmError as error:
            if error.code is not Code.TIMEOUT:
                raise
            seen = f"{len(fresh())} of {count} frames came within {limit:g} s"
            raise OpenArmError(Code.STALE_DATA, f"{seen}; are camera and detector running?") from error
        return tuple(fresh()[-count:])

    def expect_near(self, camera: str) -> None:
        """Nothing to wake: images are rendered when they are asked for."""

    def stop_observing(self) -> None:
        """Nothing is detected for now."""
        self.robot.observe("")

    # --- planning
    async def plan(self, request: PlanGrasp | PlanPlace) -> Planned:
        """Plan with the motion service.

        Raises:
            OpenArmError: Error of the planner.
        """
        start = np.array(request.start if isinstance(request, PlanGrasp) else ())
        if isinstance(request, PlanPlace) and isinstance(request.after, Trajectory):
            start = request.after.q[-1]
        asked = PlanApproachRequest(
            request.arm,
            approach_of(request),
            start,
            slowed(self.velocity_scale, request.velocity_scale),
            boxes_of(request.ignore_regions),
        )
        answer = await self._asked(lambda stopped: self.robot.motion.plan_approach(asked, stopped))
        refusals = {
            one.id: Refusal(
                one.code, one.message, bodies=(one.contact.first, one.contact.second) if one.contact else ()
            )
            for one in answer.refusals
        }
        plan = answer.plan
        if plan is None:
            raise NoWayError(answer.code, answer.message, refusals) from answer.error
        transfer, duration = plan.transfer, sum(part.duration for part in plan.parts)
        start = dict(zip(transfer.names, transfer.q[0].tolist(), strict=True))
        parts = (plan.transfer, None if request.blend else plan.approach, plan.retreat)
        return Planned(plan.chosen, *parts, refusals, plan.limit_margins, start, duration, answer.scene_version)

    async def scene_version(self) -> int:
        """Version of the planning scene of the motion service."""
        return self.robot.motion.scene.version

    async def reach(self, arm: str, T_base_tcp: Array) -> Mapping[str, float]:
        """How far the arm's TCP stays from a point, in any orientation."""
        answer = self.robot.motion.compute_ik(arm, T_base_tcp, (), position_only=True)
        return {arm: float(answer.nearest.position_error)}

    # --- moving
    async def follow(
        self, arm: str, trajectory: AnyTrajectory, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        """Follow a planned trajectory and see that the arm has arrived.

        Raises:
            OpenArmError: Same as /motion/execute; CANCELLED; ROBOT_LOST; from `guard`.
        """
        if not isinstance(trajectory, Trajectory):
            raise OpenArmError(Code.INTERNAL, f"{type(trajectory).__name__} is no trajectory of the planner")
        request = ExecuteRequest(arm, trajectory, self.max_start_delay)
        await self._moved(lambda stopped: self.robot.motion.execute(request, stopped), what, guard)

    async def move(
        self, arm: str, to: str | Array, what: str, obstacles: Sequence[GraspBox] = (), *, plan_only: bool = False
    ) -> None:
        """Move an arm on a free path to a named posture or joint positions, or its TCP on a straight line to a pose."""
        goal = NamedGoal(to) if isinstance(to, str) else JointGoal(to) if to.ndim == 1 else LineGoal(to)
        request = MoveRequest(
            arm,
            goal,
            boxes_of(obstacles),
            hand_empty=True,
            scale=self.velocity_scale,
            max_start_delay=self.max_start_delay,
            plan_only=plan_only,
        )
        await self._moved(lambda stopped: self.robot.motion.move(request, stopped), what)

    async def _moved(
        self,
        ask: Callable[[Callable[[], bool]], Awaitable[AnswerT]],
        what: str,
        guard: Callable[[], None] | None = None,
    ) -> None:
        answer = await self._asked(ask, guard)
        if answer.error is not None:
            raise OpenArmError(answer.code, f"{what}: {answer.message}") from answer.error

    async def _asked(
        self, ask: Callable[[Callable[[], bool]], Awaitable[AnswerT]], guard: Callable[[], None] | None = None
    ) -> AnswerT:
        """The service's answer; what `check` or `guard` raise meanwhile cancels the request, and is raised then."""
        faults: list[OpenArmError] = []

        def stopped() -> bool:
            try:
                if not faults:
                    self.check()
                    if guard is not None:
                        guard()
            except OpenArmError as error:
                faults.append(error)
            return bool(faults)

        answer = await ask(stopped)
        if faults:
            raise faults[0]
        return answer

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        """Move the fingers; whether they arrived or push against something."""
        robot = self.robot
        follower = robot.simulated.controller.grippers[arm]
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


def boxes_of(boxes: Sequence[GraspBox]) -> tuple[Box, ...]:
    """Boxes of the grasp as the planner's."""
    return tuple(Box(box.id, box.T_frame_box, box.size) for box in boxes)


def approach_of(request: PlanGrasp | PlanPlace) -> ApproachRequest:
    """What the planner is asked for a grasp or a place."""
    ways = request.candidates if isinstance(request, PlanGrasp) else request.targets
    targets = tuple(Target(w.id, w.T_base_tcp, w.approach_offset, w.retreat_offset, w.score) for w in ways)
    if isinstance(request, PlanGrasp):
        obstacles, touchable = (
            boxes_of((*request.obstacles, *request.target)),
            frozenset(box.id for box in request.target),
        )
        return ApproachRequest(targets, obstacles, (), touchable, attached_after=True, blend=request.blend)
    held = boxes_of(request.held)
    return ApproachRequest(targets, boxes_of(request.obstacles), held, detached_after=True, blend=request.blend)
