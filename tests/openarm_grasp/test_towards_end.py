# SPDX-License-Identifier: Apache-2.0
"""Work that is done while an arm comes to the end of its motion, and what it finds."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any, cast

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_evaluation.campaign.robot import together, turn
from openarm_grasp.config import GraspConfig
from openarm_grasp.robot.interface import RobotInterface
from openarm_grasp.robot.skills import Skills
from tests.refusals import refused

#: Ticks of a motion, and the one from which on it is near its end.
TICKS, NEAR = 20, 12


class Robot:
    """Follows a trajectory tick by tick; its hand is open."""

    together = staticmethod(together)

    def __init__(self) -> None:
        self.description, self.states, self.tick, self.fails_at = RobotDescription.load(), self, 0, TICKS + 1
        self.q = {joint: 0.0 for arm in ("left", "right") for joint in self.description.arm_joints(arm)}
        self.q |= {self.description.finger_joint(arm): 0.02 for arm in ("left", "right")}

    def latest(self) -> tuple[int, dict[str, float]]:
        return self.tick, self.q

    def check(self) -> None:
        pass

    def effort(self, joint: str) -> float:
        return -30.0

    async def until(self, done: Callable[[], bool], limit: float, what: str) -> None:
        while not done():
            await turn()

    async def follow(self, arm: str, trajectory: object, what: str, guard: Callable[[], None]) -> None:
        for self.tick in range(1, TICKS + 1):
            guard()
            if self.tick == self.fails_at:
                raise OpenArmError(Code.EXECUTION_FAILED, "blocked")
            await turn()


class Motion:
    """A motion of a robot, and work near its end that takes three ticks and may find something."""

    def __init__(self, finds: OpenArmError | None = None) -> None:
        self.robot, self.finds, self.began_at = Robot(), finds, 0
        self.skills = Skills(cast("RobotInterface", self.robot), GraspConfig())
        self.found: list[OpenArmError] = []

    def run(self) -> None:
        work: Coroutine[Any, Any, None] = self.skills.towards_end(
            self.follow, lambda: self.robot.tick >= NEAR, self.work
        )
        try:
            while True:
                work.send(None)
        except StopIteration:
            pass

    async def follow(self) -> None:
        await self.skills.follow("right", "carry", "carry", carrying=True, check=self.check)

    async def work(self) -> None:
        self.began_at = self.robot.tick
        for _ in range(3):
            await turn()
        self.found += [] if self.finds is None else [self.finds]

    def check(self) -> None:
        if self.found:
            raise self.found[0]


def test_it_is_done_on_the_way() -> None:
    motion = Motion()
    motion.run()
    assert motion.began_at == NEAR
    assert motion.robot.tick == TICKS


def test_what_it_finds_stops_the_arm_before_the_end() -> None:
    motion = Motion(OpenArmError(Code.GRASP_LOST, "lost on the way"))
    assert refused("lost on the way", motion.run).code is Code.GRASP_LOST
    assert NEAR < motion.robot.tick < TICKS


@pytest.mark.parametrize(("at", "begun"), [(NEAR - 2, False), (NEAR + 1, True)])
def test_it_is_not_begun_after_a_failure_and_is_ended_when_it_is_begun(at: int, begun: bool) -> None:
    motion = Motion(OpenArmError(Code.GRASP_LOST, "lost on the way"))
    motion.robot.fails_at = at
    assert refused("blocked", motion.run).code is Code.EXECUTION_FAILED
    assert bool(motion.began_at) is begun
    assert bool(motion.found) is begun
