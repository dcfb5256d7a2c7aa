# SPDX-License-Identifier: Apache-2.0
"""Motions of the lift that carries the arms."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.lift import LIFT
from openarm_motion.planning.lift import LiftedArms
from openarm_motion.scene.held import HeldObjects
from openarm_motion.service.context import PlanningContext
from openarm_motion.service.requests import JointGoal, MoveAnswer, MoveRequest
from openarm_motion.service.robot import RobotInterface, TrajectoryGoal, Watch
from openarm_motion.timing.trajectory import Trajectory

#: A controller has this long beyond the duration, s.
_OVERTIME = 5.0
#: Joint states are lost when they are older, s.
_LOST = 0.5


class LiftMotions:
    """Plans and executes motions of the lift; all arms are taken meanwhile.

    Args:
        robot: The robot.
        arms: On the lift.
        context: What plans start from.
        memory: What the hands hold.
        claim: Takes arms for as long as it is open.
    """

    def __init__(
        self,
        robot: RobotInterface,
        arms: LiftedArms,
        context: PlanningContext,
        memory: HeldObjects,
        claim: Callable[..., AbstractContextManager[None]],
    ) -> None:
        self._robot, self._arms, self._context, self._memory, self._claim = robot, arms, context, memory, claim

    async def move(self, request: MoveRequest, stopped: Callable[[], bool]) -> MoveAnswer:
        """Plan, and unless it is `plan_only` execute, a motion of the lift.

        Args:
            request: What is asked.
            stopped: Whether to stop.
        """
        answer, begin = MoveAnswer(), self._robot.now()
        try:
            height = _height(request)
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
        watch, goal = Watch(self._robot), controller.start(plan, 0)

        def check() -> None:
            if watch.silence > _LOST:
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


def _height(request: MoveRequest) -> float:
    """Return the position of the lift that a request asks for, m.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when it asks for something else.
    """
    q = np.ravel(request.goal.q) if isinstance(request.goal, JointGoal) else np.zeros(0)
    if q.size != 1 or not np.isfinite(q).all():
        text = f"the lift takes a joint goal of one position, m; got {q.tolist() or type(request.goal).__name__}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    return float(q[0])


def _ended(goal: TrajectoryGoal) -> bool:
    return goal.outcome is not None or goal.accepted is False
