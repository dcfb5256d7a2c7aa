# SPDX-License-Identifier: Apache-2.0
"""Carries out what the state machine asks for; every effect is a coroutine that ends (see `link_executor`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from control_msgs.action import ParallelGripperCommand
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, PlanApproach
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionClient
from rclpy.task import Future

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import BASE_FRAME, BaseNode
from openarm_grasp import convert, effects
from openarm_grasp.config import GraspConfig
from openarm_grasp.effects import Effect, Effects, Frames, Outcome, Reach, Result
from openarm_grasp.evidence import Evidence
from openarm_grasp.hand import SPEED_WINDOW_NS, HandReader
from openarm_grasp.link_executor import RobotLink
from openarm_grasp.observation import in_base
from openarm_grasp.routing import ARMS


class GraspExecutor:
    """Effects in, outcomes out.

    Args:
        node: The node that owns the clients.
        config: Parameters.
    """

    def __init__(self, node: BaseNode[Any], config: GraspConfig) -> None:
        self._node = node
        self._config = config
        self._link = RobotLink(node, config)
        self._plan = ActionClient(node, PlanApproach, "/motion/plan_approach")
        self._execute = ActionClient(node, ExecuteTrajectory, "/motion/execute")
        self._move = ActionClient(node, MoveArm, "/motion/move")
        self._ik = node.create_client(ComputeIK, "/motion/compute_ik")
        self._grippers = {
            arm: ActionClient(node, ParallelGripperCommand, f"/{arm}_gripper_controller/gripper_cmd") for arm in ARMS
        }
        self._hands = {arm: HandReader(node.description, self._link.robot.buffer, arm) for arm in ARMS}

    # --- begin, end, cancel
    async def begin(self, *, moves: bool) -> None:
        """Listen to the robot and wait until every node that a grasp needs is there.

        Raises:
            OpenArmError: NOT_READY, naming what is missing; CANCELLED.
        """
        await self._link.begin(lambda: self._missing(moves))

    def end(self) -> None:
        """Stop listening."""
        self._link.end()

    def close(self) -> None:
        """Take the clients down."""
        self._link.end()
        for client in (self._plan, self._execute, self._move, *self._grippers.values()):
            client.destroy()

    def cancel(self) -> None:
        """Let the running recipe end with CANCELLED and the arm hold."""
        self._link.cancel()

    @property
    def now_ns(self) -> int:
        """Robot time; 0 before the first joint state."""
        return self._link.now_ns

    def gap(self, arm: str) -> float:
        """Distance between the fingers, m.

        Raises:
            OpenArmError: NOT_READY, when no joint state says so.
        """
        return self._hands[arm].gap()

    def _missing(self, moves: bool) -> list[str]:
        needed = {
            "action /motion/plan_approach (motion node)": self._plan.server_is_ready(),
            "action /motion/execute (motion node)": self._execute.server_is_ready(),
            "action /motion/move (motion node)": self._move.server_is_ready(),
            "publisher of /detections_3d (detector)": self._link.sees_detector,
            "/joint_states (bridge or robot driver)": self._link.hears_joints,
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
            self._link.stop_looking()
        results: list[Result] = []
        for done, effect in enumerate(recipe):
            try:
                self._link.check()
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
                return await self._link.observe(effect.frames)
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
        faults: list[Exception] = []

        async def carry_out(part: Effect) -> None:
            # An exception that leaves a task would stop the whole executor; it is raised below.
            try:
                await self._one(part)
            except Exception as error:
                faults.append(error)

        tasks: list[Future] = [executor.create_task(carry_out, part) for part in effect.effects]
        # All end, also those beside one that failed: they watch the same cancel, robot and deadlines.
        while not all(task.done() for task in tasks):
            await self._link.tick()
        if faults:
            raise faults[0]

    async def _wait(self, duration: float) -> None:
        link = self._link
        end_ns = link.now_ns + round(duration * 1e9)
        # Simulated time may be slow; one that stands still is noticed by the link.
        what = f"waiting {duration:g} s of robot time"
        await link.until(lambda: link.now_ns >= end_ns, 20.0 * duration + 10.0, what)

    def _to_base(self, effect: effects.ToBase) -> Frames:
        if effect.frame_id == BASE_FRAME:
            return Frames(effect.frames, BASE_FRAME)
        frames = in_base(effect.frames, lambda t_ns: self._link.robot.buffer.lookup(BASE_FRAME, effect.frame_id, t_ns))
        return Frames(frames, BASE_FRAME)

    # --- moving
    async def _planned(self, effect: effects.PlanGrasp | effects.PlanPlace) -> effects.Planned:
        goal = convert.plan_goal(effect, self._config.velocity_scale)
        what = f"{effect.arm} arm: planning"
        result = await self._link.goal(self._plan, goal, self._config.limits.plan_timeout, what)
        return convert.planned_from_msg(result, len(goal.targets))

    async def _probe(self, effect: effects.ProbeReach) -> Reach:
        distances: dict[str, float] = {}
        for arm in effect.arms if self._ik.service_is_ready() else ():
            answered = self._ik.call_async(convert.reach_request(arm, effect.T_base_tcp))
            await self._link.until(answered.done, self._config.limits.answer_timeout, "/motion/compute_ik")
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
        result = await self._link.goal(client, goal, self._config.limits.move_timeout, what, guard)
        if not result.success:
            code = convert.code_from_text(result.code, Code.EXECUTION_FAILED)
            raise OpenArmError(code, f"{what}: {result.message or 'failed'}")

    async def _home(self, effect: effects.GoHome) -> None:
        config = self._config
        for arm in effect.arms:
            home = self._node.description.group_state(f"{arm}_arm", config.home_state)
            _, q = self._link.robot.buffer.latest()
            if max(abs(q[name] - value) for name, value in home.items()) <= config.home_tolerance:
                continue
            T_base_tcp = self._hands[arm].T_base_tcp()
            if T_base_tcp[2, 3] < effect.back_off_below:
                T_back = T_base_tcp @ se3.make(p=(0.0, 0.0, -config.approach.pregrasp_distance))
                try:
                    await self._one(effects.MoveLinear(arm, T_back, "back off"))
                except OpenArmError as error:
                    if error.code in (Code.CANCELLED, Code.ROBOT_LOST):
                        raise
                    # A kindness to what stands around the hand; the free path home may still be there.
                    self._node.get_logger().warning(error.message)
            goal = convert.home_goal(arm, config.home_state, effect, config.velocity_scale)
            await self._moved(self._move, goal, f"{arm} arm: go {config.home_state}")

    # --- the hand
    async def _grip(self, effect: effects.MoveGripper) -> None:
        hand, what = self._hands[effect.arm], f"{effect.arm} hand: {effect.what}"
        goal = ParallelGripperCommand.Goal()
        goal.command.name = [hand.joint]
        goal.command.position = [effect.position]
        result = await self._link.goal(self._grippers[effect.arm], goal, self._config.limits.gripper_timeout, what)
        if effect.position > 0.0:
            # The result may be here before the joint state that shows it.
            least, end_ns = effect.position - self._config.hand.open_tolerance, self.now_ns + SPEED_WINDOW_NS
            limit = self._config.limits.answer_timeout
            await self._link.until(lambda: hand.finger() >= least or self.now_ns > end_ns, limit, what)
            if hand.finger() < least:
                reached = f"{hand.finger() * 1e3:.1f} mm of {effect.position * 1e3:.0f} mm"
                raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers stopped at {reached}")
        elif not (result.stalled or result.reached_goal):
            raise OpenArmError(Code.EXECUTION_FAILED, f"{what}: the fingers neither arrived nor met anything")

    async def _measure(self, effect: effects.Measure) -> Evidence:
        hand, limit = self._hands[effect.arm], 20.0 * effect.settle + 10.0
        ready_ns = self.now_ns + SPEED_WINDOW_NS
        await self._link.until(lambda: self.now_ns >= ready_ns, limit, "reading the hand")
        end_ns = ready_ns + round(effect.settle * 1e9)
        still = self._config.held.max_speed
        rest = "waiting for the fingers to rest"
        await self._link.until(lambda: self.now_ns >= end_ns or abs(hand.gap_speed()) < still, limit, rest)
        return hand.evidence(effect.expected, self._link.robot.efforts.get(hand.joint, 0.0), effect.T_base_tcp)
