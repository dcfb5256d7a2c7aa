# SPDX-License-Identifier: Apache-2.0
"""Plans and executes motions of both arms at once, for the action /motion/move_arms."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

from openarm_interfaces.action import MoveArms
from openarm_interfaces.msg import ArmTarget
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Task
from trajectory_msgs.msg import JointTrajectory

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import ns_to_stamp, trajectory_from_msg
from openarm_common.types import Array
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm, Situation
from openarm_motion.planning.both import BothArms
from openarm_motion.planning.goals import goal_configurations, posture, yielding
from openarm_motion.planning.together import BothGoals, BothPlan, plan_any, plan_staggered, plan_together
from openarm_motion.ros import convert
from openarm_motion.ros.follower import Robot
from openarm_motion.ros.situation import Situations
from openarm_motion.timing.checks import Motion, check_trajectory

#: Both controllers begin this long after the newest joint state, so that none begins earlier than the other, s.
_HEAD_START = 0.1

_STRATEGIES: dict[int, Callable[[BothArms, Situation, BothGoals, float], BothPlan]] = {
    MoveArms.Goal.ANY: plan_any,
    MoveArms.Goal.TOGETHER: plan_together,
    MoveArms.Goal.STAGGERED: plan_staggered,
}


class BothExecutor:
    """See the module's head.

    Args:
        robot: The robot and its node.
        situations: What requests start from.
    """

    def __init__(self, robot: Robot, situations: Situations) -> None:
        self._node, self._states, self._arms = robot.node, robot.states, robot.arms
        self._followers, self._situations, self._held = robot.followers, situations, robot.held

    def arms_of(self, goal: MoveArms.Goal) -> tuple[Arm, Arm]:
        """The two arms of a goal.

        Raises:
            OpenArmError: INVALID_ARGUMENT, unless there are two different ones.
        """
        names = [target.arm for target in goal.targets]
        if len(names) != 2 or len(set(names)) != 2 or any(name not in self._arms for name in names):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"targets are for {', '.join(repr(n) for n in names) or 'no arm'}; expected two different ones of"
                f" {', '.join(self._arms)}",
            )
        return self._arms[names[0]], self._arms[names[1]]

    async def plan(
        self, goal: MoveArms.Goal, result: MoveArms.Result, stopped: Callable[[], bool]
    ) -> tuple[BothPlan, tuple[tuple[Box, ...], ...]]:
        """Plan what a goal asks, and fill in the result; returns the plan and what each arm holds on the way.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a goal that is none; as the planners of `together`.
        """
        begin = time.monotonic()
        arms = self.arms_of(goal)
        if goal.strategy not in _STRATEGIES:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"strategy is {goal.strategy}; valid: ANY 0, TOGETHER 1, STAGGERED 2"
            )
        obstacles = convert.boxes_from_msg(goal.obstacles)
        held = tuple(
            self._held.on_request(target.arm, convert.boxes_from_msg(target.attached), target.hand_empty)[0]
            for target in goal.targets
        )
        await self._situations.fresh()
        prepared = self._situations.prepare_both(
            arms, goal.velocity_scale, stopped, obstacles, held, goal.expected_scene_version
        )
        result.scene_version = prepared.version
        both = BothArms(*arms)
        starts = both.parts(prepared.now.start)
        find = [self._goals_of(arm, q, target) for arm, q, target in zip(arms, starts, goal.targets, strict=True)]
        limit = arms[0].config.planning.time_limit

        def work() -> BothPlan:
            now = prepared.complete()
            goals = tuple(one(now) for one in find)
            wanted = BothGoals((goals[0], goals[1]), obstacles, (held[0], held[1]))
            return _STRATEGIES[goal.strategy](both, now, wanted, limit)

        plan: BothPlan = await self._node.in_thread(work)
        result.trajectories = [convert.trajectory_msg(part) for part in plan.trajectories]
        result.delays, result.separation = list(plan.delays), plan.separation
        result.planning_time = time.monotonic() - begin
        seconds = max(part.duration for part in plan.trajectories)
        result.message = f"planned, {seconds:.2f} s, {plan.separation * 1e3:.0f} mm apart{prepared.note}"
        return plan, held

    async def follow(
        self,
        handle: ServerGoalHandle,
        arms: Sequence[Arm],
        trajectories: Sequence[JointTrajectory],
        stopped: Callable[[], bool],
    ) -> None:
        """Execute trajectories of several arms, begun at the same moment; when one fails the others hold.

        Raises:
            OpenArmError: the first fault; as `Follower.follow`.
        """
        stamp_ns, state = self._states.buffer.latest()
        start = ns_to_stamp(stamp_ns + int(_HEAD_START * 1e9))
        motions: list[Motion] = []
        for arm, message in zip(arms, trajectories, strict=True):
            names, t, q, v, a = trajectory_from_msg(message)
            motions.append(check_trajectory(arm, names, t, q, v, state, a))
            message.header.stamp = start
        faults: list[OpenArmError] = []
        feedback, shares = MoveArms.Feedback(stage="executing"), [0.0] * len(motions)

        async def one(k: int) -> None:
            def progress(value: float) -> None:
                shares[k] = value
                feedback.progress = min(shares)
                handle.publish_feedback(feedback)

            try:
                follower = self._followers[arms[k].name]
                await follower.follow(trajectories[k], motions[k], lambda: bool(faults) or stopped(), progress)
            except OpenArmError as error:
                faults.append(error)

        executor = self._node.executor
        if executor is None:
            raise OpenArmError(Code.INTERNAL, "the node is in no executor")
        tasks: list[Task] = [executor.create_task(one, k) for k in range(len(motions))]
        for task in tasks:
            await task
        if faults:
            raise faults[0]

    def _goals_of(self, arm: Arm, start: Array, target: ArmTarget) -> Callable[[Situation], Array]:
        """Configurations that a target stands for, to be made in a thread; poses are looked up here."""
        if target.kind == ArmTarget.JOINTS:
            q = arm.configuration(target.joint_positions, f"goal of the {arm.name} arm", 1e-3)
            return lambda _: q[None]
        if target.kind == ArmTarget.NAMED:
            return lambda _: posture(arm, target.named, start)[None]
        if target.kind == ArmTarget.YIELD:
            return lambda _: yielding(arm, start, target.named or "home")
        if target.kind == ArmTarget.POSE:
            pose = self._situations.pose(target.pose)
            return lambda now: goal_configurations(arm, now, start, pose, free_orientation=target.free_orientation)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"kind is {target.kind}; valid: JOINTS 0, POSE 1, NAMED 3, YIELD 4")
