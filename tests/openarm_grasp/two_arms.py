# SPDX-License-Identifier: Apache-2.0
"""A performer and a link to a scripted world for requests that take more than one way."""

from __future__ import annotations

from collections.abc import Coroutine
from typing import Any

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.planning.rehearsal import standing_at
from openarm_grasp.strategy import effects as fx
from openarm_grasp.strategy.legs import run_task
from openarm_grasp.strategy.performer import Performer

#: How far either arm reaches over the middle, m.
OVER = 0.10


class TwoArms(Performer):
    """A performer and a link to a scripted world in which each arm reaches its own side and a strip of the other's."""

    def __init__(self, world: Any) -> None:
        self.world, self.link = world, self
        self.deadline_ns = 0
        self.description = RobotDescription.load()
        self.notes: list[str] = []
        self.stopped: Code | None = None
        #: The arms grasp nothing that stands further away than this, m; a hand may push it from there.
        self.far = 1.0
        #: Share of a push that the object follows.
        self.follows = 1.0
        self.hands_come_behind = True
        self.pushed = 0
        self._line: np.ndarray | None = None

    def ask(self, label: str = "red", **kwargs: Any) -> fx.GraspOutcome:
        request = fx.GraspRequest(label, **kwargs)
        machine = self.world.machine
        return _run(run_task(machine, self, request, lambda: self.notes.append(machine.reason)))

    # --- performer
    def check_hands(self, machine: object, request: object) -> None:
        pass

    async def perform(self, recipe: fx.Effects) -> fx.Outcome:
        results: list[fx.Result] = []
        for done, effect in enumerate(recipe):
            try:
                if isinstance(effect, fx.PlanGrasp | fx.PlanPlace):
                    results.append(await self.plan(effect))
                    continue
            except OpenArmError as error:
                return fx.Outcome(error.code, error.message, tuple(results), done)
            if isinstance(effect, fx.Execute) and effect.trajectory == "push" and self._line is not None:
                self._push()
            outcome = self.world.perform((effect,))
            results += outcome.results
            if not outcome.ok:
                return fx.Outcome(outcome.code, outcome.message, tuple(results), done)
        return fx.Outcome(results=tuple(results), done=len(recipe))

    # --- link
    @property
    def now_ns(self) -> int:
        return self.world.t_ns

    def check(self) -> None:
        if self.stopped is not None:
            raise OpenArmError(self.stopped, "stopped on purpose")

    async def plan(self, effect: fx.PlanGrasp | fx.PlanPlace) -> fx.Planned:
        if isinstance(effect, fx.PlanGrasp):
            if "/push/" in effect.candidates[0].id:
                if not self.hands_come_behind:
                    raise OpenArmError(Code.UNREACHABLE, f"{effect.arm} arm: too far")
                self._line = effect.candidates[0].retreat_offset
                return fx.Planned(0, "transfer", "behind", "push")
            self._reach(effect.arm, effect.candidates[0].T_base_tcp[:2, 3])
            chosen = 0
        else:
            within = [i for i, way in enumerate(effect.targets) if self._reaches(effect.arm, way.position)]
            if not within:
                self._reach(effect.arm, effect.targets[0].position)
            chosen = within[0]
        outcome = self.world.perform((effect,))
        if not outcome.ok:
            raise OpenArmError(outcome.code, outcome.message)
        if isinstance(effect, fx.PlanPlace):
            self.world._target = effect.targets[chosen].position
        plan = outcome.last(fx.Planned)
        return fx.Planned(chosen, plan.transfer, plan.approach, plan.retreat)

    def _reaches(self, arm: str, p: np.ndarray) -> bool:
        y = float(p[1]) if arm == "left" else -float(p[1])
        return y >= -OVER and float(p[0]) <= self.far

    def _reach(self, arm: str, p: np.ndarray) -> None:
        if not self._reaches(arm, p):
            raise OpenArmError(Code.UNREACHABLE, f"{arm} arm: ({p[0]:.2f}, {p[1]:.2f}) is too far")

    def _push(self) -> None:
        self.pushed += 1
        assert self._line is not None
        objects = self.world.objects
        config = self.world.machine.around.config.push
        way = self._line * (1.0 - config.gap / np.linalg.norm(self._line)) * self.follows
        objects["red"] = standing_at(objects["red"], objects["red"].p_base[:2] + way[:2])


def _run(work: Coroutine[Any, Any, fx.GraspOutcome]) -> fx.GraspOutcome:
    with pytest.raises(StopIteration) as end:
        work.send(None)
    return end.value.value
