# SPDX-License-Identifier: Apache-2.0
"""One arm next to the other: it waits for the other, gives way when both wait, looks when nothing is hidden."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import Any

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame
from openarm_grasp.planning.options import NoWayError, Refusal
from openarm_grasp.robot.coordination import ArmCoordination, CoordinatedRobot
from openarm_grasp.robot.interface import PlanPlace
from tests.refusals import refused


class Robot:
    """A link whose waits let a scripted world go on, step by step."""

    def __init__(self) -> None:
        self.description = RobotDescription.load()
        self.states = self
        self.now_ns, self.deadline_ns, self.steps, self.looks, self.velocity_scale = 1, 0, 0, 0, 0.0
        config = GraspConfig()
        self.q: dict[str, float] = {}
        for arm in ("left", "right"):
            self.q |= self.description.group_state(f"{arm}_arm", config.home_state)
        self.on_step: Callable[[int], None] = lambda step: None
        self.faults: list[Code | OpenArmError] = []
        self.moves: list[str] = []
        self.warnings: list[str] = []

    def latest(self) -> tuple[int, dict[str, float]]:
        return self.now_ns, self.q

    def away(self, arm: str, by: float = 0.5) -> None:
        self.q[f"openarm_{arm}_joint1"] += by

    async def until(self, done: Callable[[], bool], limit: float, what: str, guard: object = None) -> None:
        for _ in range(20):
            if done():
                return
            self.steps += 1
            self.now_ns += 10**9
            self.on_step(self.steps)
        raise OpenArmError(Code.TIMEOUT, what)

    async def plan(self, effect: object) -> str:
        if self.faults:
            fault = self.faults.pop(0)
            raise fault if isinstance(fault, OpenArmError) else OpenArmError(fault, "the other arm is in the way")
        return "plan"

    async def move(self, arm: str, to: object, *_: object, **__: object) -> None:
        await self.plan(to)
        self.moves.append(arm)

    def check(self) -> None:
        pass

    def warn(self, text: str) -> None:
        self.warnings.append(text)

    async def observe(self, count: int, *, near: str = "") -> tuple[Frame, ...]:
        self.looks += 1
        self.now_ns += count * 10**8
        stamps = (self.now_ns - k * 10**8 for k in reversed(range(count)))
        return tuple(Frame(t_ns, ()) for t_ns in stamps)

    def stop_observing(self) -> None:
        pass


def run(work: Coroutine[Any, Any, Any]) -> Any:
    try:
        work.send(None)
    except StopIteration as end:
        return end.value
    raise AssertionError("it waits for something that never happens")


def link(robot: Robot, arm: Any, coordination: ArmCoordination | None = None) -> CoordinatedRobot:
    both = coordination or ArmCoordination(dict.fromkeys(("left", "right"), "a grasp"))
    return CoordinatedRobot(arm, robot, both, GraspConfig())  # type: ignore[arg-type]


def test_an_arm_waits_until_the_other_has_gone_on_and_plans_again() -> None:
    robot = Robot()
    robot.away("right")
    robot.faults = [Code.IN_COLLISION]
    robot.on_step = lambda step: robot.away("right", 0.2) if step == 3 else None
    assert run(link(robot, "left").plan(None)) == "plan"  # type: ignore[arg-type]
    assert robot.steps == 3


def test_what_is_not_the_other_arms_doing_is_reported_at_once() -> None:
    robot = Robot()
    robot.faults = [Code.IN_COLLISION]
    refused("in the way", run, link(robot, "left").plan(None))  # type: ignore[arg-type]
    robot.away("right")
    robot.faults = [Code.UNREACHABLE]
    with pytest.raises(OpenArmError):
        run(link(robot, "left").plan(None))  # type: ignore[arg-type]
    assert robot.steps == 0


@pytest.mark.parametrize(("meets", "waits"), [("detected/orange_0", False), ("openarm_right_link5", True)])
def test_a_plan_that_other_things_are_in_the_way_of_is_not_tried_again_when_the_arm_has_gone_on(meets, waits) -> None:
    robot = Robot()
    robot.away("right")
    refusals = {"a": Refusal(Code.UNREACHABLE, "too far"), "b": Refusal(Code.IN_COLLISION, "", bodies=("link7", meets))}
    robot.faults = [NoWayError(Code.IN_COLLISION, "a: link6 would hit detected/red_1", refusals)]
    robot.on_step = lambda step: robot.away("right", 0.2)
    if waits:
        assert run(link(robot, "left").plan(None)) == "plan"  # type: ignore[arg-type]
    else:
        refused("red_1", run, link(robot, "left").plan(None))  # type: ignore[arg-type]
    assert robot.steps == waits


def test_an_arm_plans_when_the_other_has_begun_what_it_has_planned() -> None:
    robot, coordination = Robot(), ArmCoordination(dict.fromkeys(("left", "right"), "a grasp"))
    right, left = (link(robot, arm, coordination) for arm in ("right", "left"))
    run(right.plan(None))  # type: ignore[arg-type]
    robot.on_step = lambda step: robot.away("right", 0.05) if step == 3 else None
    run(left.plan(None))  # type: ignore[arg-type]
    assert robot.steps == 3
    del coordination.planned["left"]
    run(left.plan(PlanPlace("left", (), (), (), after="lift")))  # of what comes after another motion
    assert not {"left"} & {*coordination.planned}
    run(left.plan(None))  # type: ignore[arg-type]
    run(right.observe(3))  # which has begun, and plans anew
    robot.on_step = lambda step: coordination.planned.pop("left") if step == 5 else None
    run(right.plan(None))  # type: ignore[arg-type]
    assert robot.steps == 5
    run(left.plan(None))  # type: ignore[arg-type]  # of one that does not begin at all
    assert robot.steps == 25


def test_a_plan_in_vain_and_the_end_of_a_request_let_the_other_arm_plan() -> None:
    robot, coordination = Robot(), ArmCoordination({"left": "a grasp"})
    robot.faults = [Code.UNREACHABLE]
    with coordination.taking(("right",), "a grasp"):
        right = link(robot, "right", coordination)
        refused("in the way", run, right.plan(None))  # type: ignore[arg-type]
        run(link(robot, "left", coordination).plan(None))  # type: ignore[arg-type]
        del coordination.planned["left"]
        run(right.plan(None))  # type: ignore[arg-type]
    run(link(robot, "left", coordination).plan(None))  # type: ignore[arg-type]
    assert robot.steps == 0


def test_of_two_arms_that_wait_for_each_other_the_right_one_gives_way() -> None:
    robot, coordination = Robot(), ArmCoordination({"left": "a grasp"}, {"left"})
    robot.away("left")
    robot.faults = [Code.IN_COLLISION]
    refused("in the way", run, link(robot, "right", coordination).plan(None))  # type: ignore[arg-type]
    robot, coordination = Robot(), ArmCoordination({"right": "a grasp"}, {"right"})
    robot.away("right")
    robot.faults = [Code.IN_COLLISION]
    robot.on_step = lambda step: robot.away("right", -0.5) if step == 2 else None
    assert run(link(robot, "left", coordination).plan(None)) == "plan"  # type: ignore[arg-type]
    assert coordination.waiting == {"right"}


def test_an_arm_looks_at_once_and_from_home_again_when_the_other_hides_nothing() -> None:
    robot = Robot()
    robot.away("right")
    robot.on_step = lambda step: robot.away("right", -0.5) if step == 4 else None
    left = link(robot, "left")
    run(left.observe(3))
    assert (robot.steps, robot.looks) == (0, 1)
    run(left.observe(3))
    assert (robot.steps, robot.looks) == (4, 2)
    robot.away("right")
    run(left.move("left", "home", "go home"))
    run(left.observe(3))
    assert (robot.steps, robot.looks) == (4, 3)
    robot.away("left")  # over the table
    run(left.observe(3))
    assert (robot.steps, robot.looks) == (4, 4)


def test_a_request_begins_with_frames_that_the_arm_has_just_seen_and_never_with_others() -> None:
    robot, coordination = Robot(), ArmCoordination({"left": "a grasp", "right": "a grasp"})
    seen = run(link(robot, "left", coordination).observe(3))
    robot.now_ns += 10**8
    following = link(robot, "left", coordination)
    assert run(following.observe(3)) == seen
    assert run(following.observe(3)) != seen
    run(link(robot, "right", coordination).observe(3))
    assert robot.looks == 3
    robot.now_ns += 10**9
    run(link(robot, "left", coordination).observe(3))
    run(link(robot, "left", coordination).observe(1, near="wrist"))
    assert robot.looks == 5


def test_an_arm_that_is_not_at_work_hides_nothing_that_it_would_be_waited_for() -> None:
    robot = Robot()
    robot.away("right")
    left = link(robot, "left", ArmCoordination({"left": "a grasp"}))
    for _ in range(2):
        run(left.observe(3))
    assert (robot.steps, robot.looks) == (0, 2)


def test_an_arm_at_work_is_never_sent_home_by_the_other_and_one_at_rest_as_far_as_it_can() -> None:
    robot, coordination = Robot(), ArmCoordination({"left": "a grasp", "right": "a grasp"})
    left = link(robot, "left", coordination)
    run(left.move("right", "home", "go home"))
    assert robot.moves == []
    del coordination.at_work["right"]
    run(left.move("right", "home", "go home"))
    assert robot.moves == ["right"]
    robot.faults = [Code.STOPPED]
    run(left.move("right", "home", "go home"))
    assert robot.warnings == ["left arm: the other arm is in the way; the right arm stays where it is"]
    assert coordination.sent_home == ""


def test_an_arm_that_is_sent_home_begins_its_own_work_afterwards() -> None:
    robot, coordination = Robot(), ArmCoordination({"left": "a grasp", "right": "a grasp"}, sent_home="right")
    robot.on_step = lambda step: setattr(coordination, "sent_home", "" if step == 3 else "right")
    run(link(robot, "right", coordination).move("right", "home", "go home"))
    assert (robot.steps, robot.moves) == (3, ["right"])


def test_arms_that_are_taken_are_busy_and_the_refusal_names_what_they_are_at() -> None:
    coordination = ArmCoordination()
    with coordination.taking(("left",), "a grasp of 'red'"):
        with coordination.taking(("right",), "a grasp of 'blue'"):
            for arms in (("left",), ("left", "right")):
                error = refused("a grasp of 'red'.* is running; cancel it", coordination.taking(arms, "x").__enter__)
                assert error.code is Code.BUSY
        assert list(coordination.at_work) == ["left"]
    assert not coordination.at_work
