# SPDX-License-Identifier: Apache-2.0
"""Carries out what the state machine asks for: action goals, waits of robot time, readings of joints and detections.

Everything is a coroutine on the node's executor, wakes 40 times a second while a grasp runs, and ends: by its result,
by a deadline of the wall clock, by a cancel, or because the robot went silent. Robot time is the stamp of the joint
states, so the node needs no /clock. /joint_states is subscribed only while a grasp runs, /detections_3d only in states
that look.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionClient
from rclpy.subscription import Subscription
from rclpy.task import Future
from vision_msgs.msg import Detection3DArray

from openarm_common import se3
from openarm_common.convert import stamp_to_ns
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import BASE_FRAME, BaseNode, reliable
from openarm_common.tf import RobotStateListener
from openarm_grasp import convert, effects
from openarm_grasp.config import GraspConfig
from openarm_grasp.effects import Effect, Effects, Frames, Outcome, Reach, Result
from openarm_grasp.evidence import Evidence
from openarm_grasp.hand import SPEED_WINDOW_NS, HandReader, Silence
from openarm_grasp.observation import Frame, in_base
from openarm_grasp.routing import ARMS

_TICK_S = 0.025
#: A longer pause between two ticks is this process being starved, not the robot being silent.
_STARVED_S = 0.2
_STOP_LIMIT_S = 2.0


class GraspExecutor:
    """Effects in, outcomes out.

    Args:
        node: The node that owns the clients.
        config: Parameters.
    """

    def __init__(self, node: BaseNode[Any], config: GraspConfig) -> None:
        self._node = node
        self._config = config
        self._robot = RobotStateListener(node, node.description, joints=False)
        self._plan = ActionClient(node, PlanApproach, "/motion/plan_approach")
        self._execute = ActionClient(node, ExecuteTrajectory, "/motion/execute")
        self._move = ActionClient(node, MoveArm, "/motion/move")
        self._ik = node.create_client(ComputeIK, "/motion/compute_ik")
        self._grippers = {
            arm: ActionClient(node, ParallelGripperCommand, f"/{arm}_gripper_controller/gripper_cmd") for arm in ARMS
        }
        self._detections: Subscription | None = None
        self._frames: list[Frame] = []
        self._frame_id = BASE_FRAME
        self._looking_since_ns = 0
        self._next_tick = Future()
        self._timer = node.create_timer(_TICK_S, self._on_tick, clock=node.wall_clock)
        self._timer.cancel()
        self._silence = Silence(_STARVED_S)
        self._hands = {arm: HandReader(node.description, self._robot.buffer, arm) for arm in ARMS}
        self._cancelled = self._active = False

    # --- begin, end, cancel
    async def begin(self, *, moves: bool) -> None:
        """Listen to the robot and wait until every node that a grasp needs is there.

        Raises:
            OpenArmError: NOT_READY, naming what is missing; CANCELLED.
        """
        self._cancelled = False
        self._silence = Silence(_STARVED_S)
        self._active = True
        self._robot.enable(True)
        self._timer.reset()
        deadline = time.monotonic() + self._config.limits.ready_timeout
        while missing := self._missing(moves):
            self._check()
            if time.monotonic() > deadline:
                raise OpenArmError(Code.NOT_READY, f"not ready: no {'; no '.join(missing)}")
            await self._tick()

    def end(self) -> None:
        """Stop listening."""
        if not self._active:
            return
        self._active = False
        self._stop_looking()
        self._timer.cancel()
        self._robot.enable(False)

    def close(self) -> None:
        """Take the clients down."""
        self.end()
        for client in (self._plan, self._execute, self._move, *self._grippers.values()):
            client.destroy()

    def cancel(self) -> None:
        """Let the running recipe end with CANCELLED and the arm hold."""
        self._cancelled = True

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return max(self._silence.newest_ns, 0)

    def gap(self, arm: str) -> float:
        """Distance between the fingers, m.

        Raises:
            OpenArmError: NOT_READY, when no joint state says so.
        """
        return self._hands[arm].gap()

    def _missing(self, moves: bool) -> list[str]:
        detections = self._node.resolve_topic_name("/detections_3d")
        needed = {
            "action /motion/plan_approach (motion node)": self._plan.server_is_ready(),
            "action /motion/execute (motion node)": self._execute.server_is_ready(),
            "action /motion/move (motion node)": self._move.server_is_ready(),
            "publisher of /detections_3d (detector)": self._node.count_publishers(detections) > 0,
            "/joint_states (bridge or robot driver)": self._robot.age_s() < float("inf"),
        }
        if moves:
            for arm, client in self._grippers.items():
                name = f"action /{arm}_gripper_controller/gripper_cmd (bridge or robot driver)"
                needed[name] = client.server_is_ready()
        return [what for what, there in needed.items() if not there]

    # --- recipes
    async def perform(self, recipe: Effects) -> Outcome:
        """Carry out a recipe; the first effect that fails ends it."""
        if not any(isinstance(effect, effects.Observe) for effect in recipe):
            self._stop_looking()
        results: list[Result] = []
        for done, effect in enumerate(recipe):
            try:
                self._check()
                result = await self._one(effect)
            except OpenArmError as error:
                return Outcome(error.code, error.message, tuple(results), done)
            if result is not None:
                results.append(result)
        return Outcome(Code.OK, "", tuple(results), len(recipe))

    async def _one(self, effect: Effect) -> Result | None:
        match effect:
            case effects.Together():
                return await self._together(effect)
            case effects.Wait():
                return await self._wait(effect.duration)
            case effects.Observe():
                return await self._observe(effect.frames)
            case effects.ToBase():
                return self._to_base(effect)
            case effects.PlanGrasp() | effects.PlanPlace():
                return await self._planned(effect)
            case effects.ProbeReach():
                return await self._probe(effect)
            case effects.Execute():
                return await self._follow(effect)
            case effects.MoveLinear():
                goal = convert.linear_goal(effect, self._config.velocity_scale)
                return await self._moved(self._move, goal, f"{effect.arm} arm: {effect.what}")
            case effects.GoHome():
                return await self._home(effect)
            case effects.MoveGripper():
                return await self._grip(effect)
            case effects.Measure():
                return await self._measure(effect)

    async def _together(self, effect: effects.Together) -> None:
        executor = self._node.executor
        if executor is None:
            raise OpenArmError(Code.INTERNAL, "the grasp node is not in an executor")
        faults: list[OpenArmError] = []

        async def carry_out(part: Effect) -> None:
            # An exception that leaves a task would stop the whole executor.
            try:
                await self._one(part)
            except OpenArmError as error:
                faults.append(error)

        tasks: list[Future] = [executor.create_task(carry_out, part) for part in effect.effects]
        # All end, also those beside one that failed: they watch the same cancel, robot and deadlines.
        while not all(task.done() for task in tasks):
            await self._tick()
        if faults:
            raise faults[0]

    # --- waiting
    def _on_tick(self) -> None:
        has_state = self._robot.age_s() < float("inf")
        self._silence.look(time.monotonic(), self._robot.buffer.latest()[0] if has_state else -1)
        done, self._next_tick = self._next_tick, Future()
        done.set_result(None)

    async def _tick(self) -> None:
        await self._next_tick

    def _check(self) -> None:
        if self._cancelled:
            raise OpenArmError(Code.CANCELLED, "cancelled; the arm holds where it is and the hand keeps what it holds")
        self._silence.check(self._config.limits.joint_state_timeout)

    async def _until(
        self, done: Callable[[], bool], limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        deadline = time.monotonic() + limit
        while not done():
            self._check()
            if guard is not None:
                guard()
            if time.monotonic() > deadline:
                raise OpenArmError(Code.TIMEOUT, f"{what}: not done within {limit:g} s")
            await self._tick()

    async def _wait(self, duration: float) -> None:
        end_ns = self.now_ns + round(duration * 1e9)
        # Simulated time may be slow; one that stands still is noticed by `_check`.
        what = f"waiting {duration:g} s of robot time"
        await self._until(lambda: self.now_ns >= end_ns, 20.0 * duration + 10.0, what)

    async def _goal(
        self, client: ActionClient, goal: object, limit: float, what: str, guard: Callable[[], None] | None = None
    ) -> Any:
        """Send a goal and return its result message; whatever ends the wait early cancels the goal."""
        limits = self._config.limits
        try:
            await self._until(client.server_is_ready, limits.ready_timeout, what)
        except OpenArmError as error:
            if error.code is Code.TIMEOUT:
                raise OpenArmError(Code.NOT_READY, f"{what}: its action server is not there") from error
            raise
        sent = client.send_goal_async(goal)
        try:
            await self._until(sent.done, limits.answer_timeout, f"{what}: acceptance of the goal")
        except OpenArmError:
            # Should it be accepted yet, it is withdrawn.
            sent.add_done_callback(lambda f: f.result().cancel_goal_async() if f.result().accepted else None)
            raise
        handle = sent.result()
        if not handle.accepted:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the goal was rejected")
        result = handle.get_result_async()
        try:
            await self._until(result.done, limit, what, guard)
        except OpenArmError as error:
            handle.cancel_goal_async()
            deadline = time.monotonic() + (0.0 if error.code is Code.ROBOT_LOST else _STOP_LIMIT_S)
            while not result.done() and time.monotonic() < deadline:
                await self._tick()
            raise
        return result.result().result

    # --- looking
    async def _observe(self, count: int) -> Frames:
        self._frames = []
        self._looking_since_ns = self.now_ns
        if self._detections is None:
            self._detections = self._node.create_subscription(
                Detection3DArray, "/detections_3d", self._on_detections, reliable(5)
            )
        limit = self._config.detect.frame_timeout
        try:
            await self._until(lambda: len(self._frames) >= count, limit, "looking")
        except OpenArmError as error:
            if error.code is not Code.TIMEOUT:
                raise
            seen = f"{len(self._frames)} of {count} frames came from /detections_3d within {limit:g} s"
            raise OpenArmError(Code.STALE_DATA, f"{seen}; are camera and detector running?") from error
        return Frames(tuple(self._frames[-count:]), self._frame_id)

    def _on_detections(self, message: Detection3DArray) -> None:
        # What the camera took before this look began shows another state of the world.
        if stamp_to_ns(message.header.stamp) < self._looking_since_ns:
            return
        try:
            self._frames.append(convert.frame_from_msg(message))
        except OpenArmError as error:
            self._node.get_logger().warning(f"dropped a frame of detections: {error.message}")
            return
        self._frame_id = message.header.frame_id

    def _stop_looking(self) -> None:
        if self._detections is not None:
            self._node.destroy_subscription(self._detections)
            self._detections = None

    def _to_base(self, effect: effects.ToBase) -> Frames:
        if effect.frame_id == BASE_FRAME:
            return Frames(effect.frames, BASE_FRAME)
        frames = in_base(effect.frames, lambda t_ns: self._robot.buffer.lookup(BASE_FRAME, effect.frame_id, t_ns))
        return Frames(frames, BASE_FRAME)

    # --- moving
    async def _planned(self, effect: effects.PlanGrasp | effects.PlanPlace) -> effects.Planned:
        goal = convert.plan_goal(effect, self._config.velocity_scale)
        what = f"{effect.arm} arm: planning"
        result = await self._goal(self._plan, goal, self._config.limits.plan_timeout, what)
        return convert.planned_from_msg(result, len(goal.targets))

    async def _probe(self, effect: effects.ProbeReach) -> Reach:
        distances: dict[str, float] = {}
        for arm in effect.arms if self._ik.service_is_ready() else ():
            answered = self._ik.call_async(convert.reach_request(arm, effect.T_base_tcp))
            await self._until(answered.done, self._config.limits.answer_timeout, "/motion/compute_ik")
            distances |= convert.reach_from_msg(arm, answered.result(), effect.T_base_tcp)
        return Reach(distances)

    async def _follow(self, effect: effects.Execute) -> None:
        def still_held() -> None:
            gap = self.gap(effect.arm)
            if effect.carrying and gap <= self._config.held.closed_below:
                raise OpenArmError(Code.GRASP_LOST, f"{effect.what}: the hand closed to {gap * 1e3:.1f} mm on the way")

        goal = ExecuteTrajectory.Goal(arm=effect.arm, trajectory=effect.trajectory)
        await self._moved(self._execute, goal, f"{effect.arm} arm: {effect.what}", still_held)

    async def _moved(
        self, client: ActionClient, goal: object, what: str, guard: Callable[[], None] | None = None
    ) -> None:
        result = await self._goal(client, goal, self._config.limits.move_timeout, what, guard)
        if not result.success:
            code = convert.code_from_text(result.code, Code.EXECUTION_FAILED)
            raise OpenArmError(code, f"{what}: {result.message or 'failed'}")

    async def _home(self, effect: effects.GoHome) -> None:
        config = self._config
        for arm in effect.arms:
            home = self._node.description.group_state(f"{arm}_arm", config.home_state)
            _, q = self._robot.buffer.latest()
            if max(abs(q[name] - value) for name, value in home.items()) <= config.home_tolerance:
                continue
            T_base_tcp = self._hands[arm].T_base_tcp()
            if T_base_tcp[2, 3] < effect.back_off_below:
                T_back = T_base_tcp @ se3.make(p=(0.0, 0.0, -config.approach.pregrasp_distance))
                await self._one(effects.MoveLinear(arm, T_back, "back off"))
            goal = convert.home_goal(arm, config.home_state, effect, config.velocity_scale)
            await self._moved(self._move, goal, f"{arm} arm: go {config.home_state}")

    # --- the hand
    async def _grip(self, effect: effects.MoveGripper) -> None:
        hand, what = self._hands[effect.arm], f"{effect.arm} hand: {effect.what}"
        goal = ParallelGripperCommand.Goal()
        goal.command.name = [hand.joint]
        goal.command.position = [effect.position]
        result = await self._goal(self._grippers[effect.arm], goal, self._config.limits.gripper_timeout, what)
        if effect.position > 0.0:
            # The result may be here before the joint state that shows it.
            least, end_ns = effect.position - self._config.hand.open_tolerance, self.now_ns + SPEED_WINDOW_NS
            limit = self._config.limits.answer_timeout
            await self._until(lambda: hand.finger() >= least or self.now_ns > end_ns, limit, what)
            if hand.finger() < least:
                reached = f"{hand.finger() * 1e3:.1f} mm of {effect.position * 1e3:.0f} mm"
                raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers stopped at {reached}")
        elif not (result.stalled or result.reached_goal):
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers neither arrived nor met anything")

    async def _measure(self, effect: effects.Measure) -> Evidence:
        hand, limit = self._hands[effect.arm], 20.0 * effect.settle + 10.0
        ready_ns = self.now_ns + SPEED_WINDOW_NS
        await self._until(lambda: self.now_ns >= ready_ns, limit, "reading the hand")
        end_ns = ready_ns + round(effect.settle * 1e9)
        still = self._config.held.max_speed
        rest = "waiting for the fingers to rest"
        await self._until(lambda: self.now_ns >= end_ns or abs(hand.gap_speed()) < still, limit, rest)
        return hand.evidence(effect.expected, self._robot.efforts.get(hand.joint, 0.0), effect.T_base_tcp)
