# SPDX-License-Identifier: Apache-2.0
"""Learning a hand, and the width that one which opens less admits: a hand with stops, without physics."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field
from typing import Any, cast

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.robot.zeros import HandReach
from openarm_common.scene.scene import load_scene
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import Box
from openarm_grasp.planning.offers import asked, offers
from openarm_grasp.robot.interface import RobotInterface
from openarm_grasp.robot.learn import learn_hand
from openarm_grasp.robot.skills import Skills
from tests.openarm_grasp.scripted import standing
from tests.refusals import refused, refuses

CONFIG = GraspConfig()
#: N/m of the drive of a finger.
STIFF = 4000.0


@dataclass
class Fingers:
    """The right hand of a robot: its fingers stop at both ends, and at what is between them, m from the middle.

    Attributes:
        closed, opened: Stops.
        held: What is between the fingers, and falls when they open; it stays where they are wide open.
    """

    closed: float
    opened: float
    held: float = 0.0
    stays: bool = False
    at: float = 0.0
    box: Box | None = None
    description: RobotDescription = field(default_factory=lambda: RobotDescription.load("openarm_v1"))

    def __post_init__(self) -> None:
        self.states, self.now_ns, self.force = RobotStateBuffer(self.description), 0, 0.0
        self.at = max(self.at, self.closed, self.held)
        self.tick(30)

    def tick(self, n: int = 1) -> None:
        for _ in range(n):
            self.now_ns += 10_000_000
            q = self.description.group_state("right_arm", "home") | {"openarm_right_finger_joint1": self.at}
            self.states.add_joint_state(self.now_ns, list(q), list(q.values()))

    async def grip(self, arm: str, joint: str, position: float, what: str, effort: float = 0.0) -> bool:
        if position > self.at and not self.stays:
            self.held = 0.0
        self.at = float(np.clip(position, max(self.closed, self.held), self.opened))
        self.force = STIFF * (position - self.at)
        self.tick(30)
        return True

    async def until(self, done: Callable[[], bool], limit: float, what: str, guard: object = None) -> None:
        while not done():
            self.tick()

    def effort(self, joint: str) -> float:
        return self.force

    def held_box(self, arm: str) -> Box | None:
        return self.box

    def check(self) -> None:
        pass

    def learn(self) -> HandReach:
        return run(learn_hand(self.skills(), "right", 1.0))

    def skills(self, **learned: HandReach) -> Skills:
        self.description = self.description.with_hands(learned)
        return Skills(cast("RobotInterface", self), CONFIG)


def run(work: Coroutine[Any, Any, Any]) -> Any:
    with pytest.raises(StopIteration) as end:
        work.send(None)
    return end.value.value


@pytest.mark.parametrize("begin", [0.0, 0.02, 0.044])
def test_both_ends_and_the_force_of_a_closed_hand_are_learned_wherever_it_begins(begin: float) -> None:
    fingers = Fingers(0.0016, 0.038, at=min(begin, 0.038))
    reach = fingers.learn()
    assert (reach.closed, reach.opened, reach.effort) == pytest.approx((0.0016, 0.038, 6.4))
    assert reach.learned.startswith("20")
    assert fingers.at == 0.0016
    learned = fingers.skills(right=reach)
    assert learned.is_closed("right")
    run(learned.open("right", "open"))
    assert fingers.at == 0.038
    assert learned.is_open("right")


def test_a_hand_that_is_as_drawn_is_learned_so() -> None:
    assert Fingers(0.0, 0.05).learn().opened == 0.044  # what it is asked to open
    fingers = Fingers(0.0, 0.044)
    assert fingers.learn().model_dump(exclude={"learned"}) == {"closed": 0.0, "opened": 0.044, "effort": 0.0}


@pytest.mark.parametrize(
    ("fingers", "text", "at"),
    [
        (Fingers(0.0016, 0.038, held=0.015), "closes to 30.0 mm, expected 0 to 8.8 mm of an empty one", 0.015),
        (Fingers(0.0016, 0.038, held=0.015, stays=True, at=0.038), "closes to 30.0 mm", 0.038),  # it is opened again
        (Fingers(0.0016, 0.038, held=0.004), "closes to 8.0 mm, and then to 3.2 mm", 0.0016),  # a pen, which fell
        (Fingers(0.0016, 0.020), "opens to 40.0 mm, expected 52.8 to 88.0 mm", 0.020),
        (Fingers(0.0016, 0.038, box=Box("red", np.eye(4), np.ones(3))), "holds what was picked", 0.0016),
    ],
)
def test_what_is_between_the_fingers_is_not_learned(fingers: Fingers, text: str, at: float) -> None:
    with refuses(Code.NOT_READY, f"the right hand {text}.*take out.*`openarm hardware learn-hand --arm right`"):
        fingers.learn()
    assert fingers.at == at


def test_a_hand_that_does_not_open_says_what_to_type_and_what_was_learned() -> None:
    old = HandReach(closed=0.0, opened=0.042, learned="2026-10-01")
    for learned, text in (
        ({}, "44 mm; .*farther"),
        ({"right": old}, r"42 mm; .*\(0.0 to 84.0 mm, learned 2026-10-01\)"),
    ):
        with refuses(Code.EXECUTION_FAILED, f"stopped at 36.0 mm of {text}: `openarm hardware learn-hand --arm right`"):
            run(Fingers(0.0016, 0.036).skills(**learned).open("right", "open"))


def test_each_hand_grasps_what_it_has_room_around_and_refuses_the_rest_with_its_width() -> None:
    narrow = HandReach(closed=0.0, opened=0.038)
    robot = RobotDescription.load("openarm_v1").with_hands({"right": narrow})
    context = GraspContext.of(CONFIG, load_scene("demo").table, robot)
    assert context.config_of("left") is CONFIG
    assert context.config_of("right").approach.max_width == pytest.approx(0.066)
    box = Sighting(standing("red", 0.26, 0.0, size=0.072), (), 0)
    assert offers(context, "left", box)
    assert refused("sides up to 66 mm", offers, context, "right", box).code is Code.TOO_WIDE
    assert offers(context, "right", Sighting(standing("red", 0.26, 0.0, size=0.065), (), 0))
    assert asked(context, "right", box).config.approach.max_width == pytest.approx(0.066)
    opened = {arm: context.shape(arm).opening for arm in ("left", "right")}
    assert opened == {"left": 0.044, "right": 0.038}
