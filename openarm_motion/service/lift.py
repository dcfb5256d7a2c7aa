# SPDX-License-Identifier: Apache-2.0
"""Motions of the lift that carries the arms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.lift import LIFT
from openarm_common.types import Array
from openarm_motion.service.robot import RobotInterface, RobotWatch, TrajectoryGoal

if TYPE_CHECKING:
    from openarm_motion.planning.lift import LiftedArms
    from openarm_motion.scene.held import HeldObjects
    from openarm_motion.service.context import PlanningContext
    from openarm_motion.service.requests import MoveAnswer, MoveRequest
    from openarm_motion.timing.trajectory import Trajectory

#: A controller has this long beyond the duration, s.
_OVERTIME = 5.0


class LiftMotions:
    """Plans and executes motions of the lift; all arms are taken meanwhile.

    Args:
        robot: The robot.
        arms: Arms on the lift.
        context: Context that plans start from.
        memory: Memory of what the hands hold.
        claim: Takes arms for as long as it is open.
        stale_after: Age of joint states that counts as lost, s.
    """

    def __init__(
        self,
        robot: RobotInterface,
        arms: LiftedArms,
        context: PlanningContext,
        memory: HeldObjects,
        claim: Callable[..., AbstractContextManager[None]],
        stale_after: float,
    ) -> None:
        self._robot, self._arms, self._context, self._memory, self._claim = robot, arms, context, memory, claim
        self._stale_after = stale_after

    async def move(
        self, goal: Array, request: MoveRequest, stopped: Callable[[], bool], answer: MoveAnswer
    ) -> MoveAnswer:
        """Plan, and unless it is `plan_only` execute, a motion of the lift.

        Args:
            goal: (1,) position of the lift, m; of another size when the request asks for something else.
            request: Request.
            stopped: Whether to stop.
            answer: Answer to fill.
        """
        begin = self._robot.now()
        try:
            height = _height(goal)
            with self._claim(*self._arms, wanted=not request.plan_only):
                await self._context.fresh()
                self._arms.follow(self._robot.states.latest()[1])
                arms, held = dict(self._arms), {name: tuple(self._memory.held.get(name, ())) for name in self._arms}
                prepared = self._context.prepare(
                    list(arms.values()), (), request.scale, stopped, request.obstacles, list(held.values()),
                    request.scene_version,
                )  # fmt: skip
                answer = replace(answer, scene_version=prepared.version)
                plan = await self._robot.compute(
                    lambda: self._arms.motion.plan(arms, prepared.complete(), held, height, request.obstacles)
                )
                message = f"planned, {plan.duration:.2f} s{prepared.note}"
                answer = replace(answer, trajectory=plan, planning_time=self._robot.now() - begin, message=message)
                if not request.plan_only:
                    await self._follow(plan, stopped)
                    self._arms.follow(self._robot.states.latest()[1])
                    answer = replace(answer, message="arrived")
        except OpenArmError as error:
            return replace(answer, error=error, message=error.message)
        return answer

    async def _follow(self, plan: Trajectory, stopped: Callable[[], bool]) -> None:
        controller = self._robot.controller(LIFT)
        if not controller.ready():
            raise OpenArmError(Code.NOT_READY, f"{controller.name} is not there")
        watch, goal = RobotWatch(self._robot), controller.start(plan, 0, touches=True)

        def check() -> None:
            if watch.silence > self._stale_after:
                goal.cancel()
                raise OpenArmError(Code.ROBOT_LOST, f"joint states have been silent for {watch.silence:.1f} s")
            if stopped():
                goal.cancel()
                raise OpenArmError(Code.CANCELLED, "the motion of the lift was cancelled; it holds where it is")

        if not await watch.until(lambda: _ended(goal), check, plan.duration + _OVERTIME):
            goal.cancel()
            raise OpenArmError(Code.TIMEOUT, f"the lift did not arrive within {plan.duration + _OVERTIME:.1f} s")
        if goal.outcome is None:
            raise OpenArmError(Code.EXECUTION_FAILED, f"{controller.name} refused the motion")
        if not goal.outcome.success:
            raise OpenArmError(goal.outcome.code, f"{controller.name}: {goal.outcome.text}")


def _height(goal: Array) -> float:
    if goal.shape != (1,) or not np.isfinite(goal).all():
        got = f"{goal.tolist()}" if goal.size else "another kind of goal"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"the lift takes a joint goal of one position, m; got {got}")
    return float(goal[0])


def _ended(goal: TrajectoryGoal) -> bool:
    return goal.outcome is not None or goal.accepted is False
