# SPDX-License-Identifier: Apache-2.0
"""What the tests of the state machine share: a scripted world with a clock of its own; no ROS, no sleeping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Table
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.evidence import Evidence
from openarm_grasp.evidence.observation import Detection, Frame
from openarm_grasp.strategy import effects as fx
from openarm_grasp.strategy.machine import GraspMachine
from openarm_grasp.strategy.memory import Surroundings
from openarm_grasp.strategy.states import State
from tests.openarm_grasp.two_arms import TwoArms

Fault = Callable[[fx.Effect], OpenArmError | None]


def standing(label: str, x: float, y: float, size: float = 0.05, z: float = 0.4) -> Detection:
    return Detection(label, 0.9, se3.make(p=(x, y, z + size / 2.0)), np.array([size, size, size]))


class World:
    """Carries recipes out on a table in the head: objects, one hand, a clock, and faults by name."""

    def __init__(self, *objects: Detection, **config: object) -> None:
        self.objects = {d.label: d for d in objects}
        self.t_ns = 1_000_000_000
        self.gap = 0.0
        self.held: str | None = None
        self.faults: list[Fault] = []
        self.log: list[tuple[float, fx.Effect]] = []
        self.states: list[State] = []
        self.slips = 0  # closes that get nothing
        self.tcp_error = 0.0
        self.place_error = 0.0
        self.frame_age = 0.0
        self.machine = GraspMachine(
            Surroundings(
                GraspConfig.model_validate({"near": {"enabled": False}, **config}),
                Table(),
                {"left": (0.0, 0.15), "right": (0.0, -0.15)},
            )
        )
        self._target = np.zeros(3)
        self._label = ""

    # --- running
    def grasp(self, label: str = "red", **kwargs) -> fx.GraspOutcome:
        recipe = self.machine.step(fx.GraspRequest(label, **kwargs), self.t_ns)
        self.states = [self.machine.state]
        for _ in range(400):
            if not recipe:
                outcome = self.machine.outcome
                assert outcome is not None
                assert self.machine.state is State.IDLE
                return outcome
            recipe = self.machine.step(self.perform(recipe), self.t_ns)
            self.states.append(self.machine.state)
        raise AssertionError("the grasp did not end")

    def perform(self, recipe: fx.Effects) -> fx.Outcome:
        results = []
        for done, effect in enumerate(recipe):
            for part in effect.effects if isinstance(effect, fx.Together) else (effect,):
                self.log.append((self.t_ns * 1e-9, part))
                for fault in self.faults:
                    error = fault(part)
                    if error is not None:
                        return fx.Outcome(error.code, error.message, tuple(results), done)
                result = self.carry_out(part)
                if result is not None:
                    results.append(result)
        return fx.Outcome(results=tuple(results), done=len(recipe))

    def carry_out(self, effect: fx.Effect) -> fx.Result | None:
        match effect:
            case fx.Wait():
                self.pass_time(effect.duration)
            case fx.Observe():
                return self.frames(effect.frames)
            case fx.ToBase():
                return fx.Frames(effect.frames, "base")
            case fx.PlanGrasp():
                self._label = effect.target.id.removeprefix("target/")
                return fx.Planned(0, "transfer", "approach", "lift")
            case fx.PlanPlace():
                self._target = effect.targets[0].position
                return fx.Planned(0, "carry", "put down", "leave")
            case fx.ProbeReach():
                return fx.Reach(dict.fromkeys(effect.arms, 0.2))
            case fx.Execute():
                self.pass_time(1.0)
                if effect.trajectory == "lift" and self.held:
                    self.objects.pop(self.held)
            case fx.GoHome() | fx.MoveLinear():
                self.pass_time(1.0)
            case fx.MoveGripper():
                self.pass_time(0.6)
                self.move_gripper(effect.position)
            case fx.Measure():
                effort = -30.0 if self.held else 0.0
                error = self.tcp_error if effect.T_base_tcp is not None else 0.0
                return Evidence(self.gap, effect.expected, effort, 0.0, error)
            case _:
                raise AssertionError(effect)
        return None

    def move_gripper(self, position: float) -> None:
        if position > 0.0:
            if self.held:
                x, y, _ = self._target
                self.objects[self.held] = standing(self.held, x + self.place_error, y)
            self.held, self.gap = None, 2.0 * position
        elif self.slips or self._label not in self.objects:
            self.slips, self.gap = max(0, self.slips - 1), 0.0
        else:
            self.held, self.gap = self._label, float(self.objects[self._label].size[0])

    def frames(self, count: int) -> fx.Frames:
        seen = tuple(self.objects.values())
        found = []
        for _ in range(count):
            self.pass_time(0.1)
            found.append(Frame(self.t_ns - round(self.frame_age * 1e9), seen))
        return fx.Frames(tuple(found), "base")

    def pass_time(self, seconds: float) -> None:
        self.t_ns += round(seconds * 1e9)

    # --- faults
    def fail(self, chosen: Callable[[fx.Effect], bool], code: Code, times: int = 10**6) -> None:
        """Let effects end with a code, so many times."""
        left = [times]

        def fault(effect: fx.Effect) -> OpenArmError | None:
            if left[0] > 0 and chosen(effect):
                left[0] -= 1
                return OpenArmError(code, f"{type(effect).__name__} failed on purpose")
            return None

        self.faults.append(fault)

    @staticmethod
    def executes(trajectory: str) -> Callable[[fx.Effect], bool]:
        """Tells the effect that follows a trajectory of that name."""
        return lambda effect: isinstance(effect, fx.Execute) and effect.trajectory == trajectory

    @staticmethod
    def grips(*, opening: bool) -> Callable[[fx.Effect], bool]:
        """Tells the effect that opens or closes the hand."""
        return lambda effect: isinstance(effect, fx.MoveGripper) and (effect.position > 0.0) == opening

    # --- what happened
    def done(self, kind: type) -> list:
        return [effect for _, effect in self.log if isinstance(effect, kind)]

    def times(self, chosen: Callable[[fx.Effect], bool]) -> list[float]:
        return [t for t, effect in self.log if chosen(effect)]


@pytest.fixture
def box() -> Callable[..., Detection]:
    """Makes a cube on the table: label, x, y, and edge, m."""
    return standing


@pytest.fixture
def worlds() -> Callable[..., World]:
    """Makes a world of its objects and parameters of the grasp."""
    return World


@pytest.fixture
def world() -> World:
    """A red cube on the right, a blue one on the left."""
    return World(standing("red", 0.26, -0.2), standing("blue", 0.26, 0.2))


@pytest.fixture
def robot(worlds: Callable[..., Any], box: Callable[..., Any]) -> Callable[..., TwoArms]:
    def make(x: float, y: float, *others: tuple[str, float, float], **config: Any) -> TwoArms:
        return TwoArms(worlds(box("red", x, y), *(box(*other) for other in others), **config))

    return make
