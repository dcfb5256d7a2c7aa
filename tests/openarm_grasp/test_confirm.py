# SPDX-License-Identifier: Apache-2.0
"""P-20, R-25: a plan is shown, a person confirms it, and then that plan is executed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.requests.confirm import ShownPlan
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.states import State
from openarm_grasp.requests.task import Status
from openarm_grasp.robot.interface import PlanGrasp
from openarm_grasp.strategies.pick_and_place import pick_and_place
from openarm_motion.timing.trajectory import Motion
from tests.openarm_grasp.scripted import Follow, GoHome, Grip, MoveLinear, World, standing
from tests.refusals import refused

pytestmark = pytest.mark.requirement("P-20", "R-25")

#: What a person does with the plan that waits; after the last of them all are confirmed.
Answer = Callable[[World, Status], None]


def confirm(world: World, status: Status, *, accept: bool = True) -> None:
    assert status.plan is not None
    world.session.gate.answer(status.plan.id, accept=accept)


def reject(world: World, status: Status) -> None:
    confirm(world, status, accept=False)


def watched(world: World, *answers: Answer) -> list[ShownPlan]:
    """The plans that are shown, each answered."""
    shown: list[ShownPlan] = []
    left = list(answers)

    def on_report(status: Status) -> None:
        if status.plan is not None:
            shown.append(status.plan)
            assert status.plan.id in status.reason
            (left.pop(0) if left else confirm)(world, status)

    world.on_report = on_report
    return shown


def names(plan: ShownPlan) -> list[str]:
    return [name for name, _ in plan.parts]


def is_executed(world: World, *plans: ShownPlan) -> bool:
    """Whether these trajectories were executed, all of them, and no others."""
    parts = [part for plan in plans for _, part in plan.parts]
    return len(parts) == len(world.followed) and all(a is b for a, b in zip(parts, world.followed, strict=True))


def moves(world: World) -> list[object]:
    return [call for kind in (Follow, Grip, GoHome, MoveLinear) for call in world.done(kind)]


@pytest.fixture
def world() -> World:
    """A red cube on the right, alone."""
    return World(standing("red", 0.3, -0.2))


def test_the_plan_that_is_shown_and_confirmed_is_executed_and_no_other(world: World) -> None:

    def nothing_has_moved(world: World, status: Status) -> None:
        assert moves(world) == []
        assert status.state is State.PLAN
        assert "grasp red/" in status.reason
        assert "with the right arm, place spot" in status.reason
        assert "6.0 s of motion" in status.reason
        confirm(world, status)

    shown = watched(world, nothing_has_moved)
    world.succeeds(confirm=True)
    assert [names(plan) for plan in shown] == [["transfer", "approach", "lift", "carry", "leave"]]
    assert is_executed(world, *shown)


def test_a_rejected_plan_ends_with_cancelled_and_nothing_has_moved(world: World) -> None:
    shown = watched(world, reject)
    outcome = world.grasp(confirm=True)
    assert (outcome.code, outcome.kind, outcome.attempts) == (Code.CANCELLED, "CANCELLED", 0)
    assert f"plan '{shown[0].id}' was rejected" in outcome.message
    assert moves(world) == []


def test_only_the_plan_that_waits_can_be_answered(world: World) -> None:
    gate = world.session.gate
    assert refused("no plan waits", gate.answer, "x", accept=True).code is Code.NOT_READY

    def another_first(world: World, status: Status) -> None:
        assert status.plan is not None
        assert refused(f"plan '{status.plan.id}' does", gate.answer, "x", accept=True).code is Code.INVALID_ARGUMENT
        confirm(world, status)
        refused("no plan waits", confirm, world, status, accept=False)  # it can't be taken back

    shown = watched(world, another_first)
    assert world.grasp(confirm=True).success
    assert is_executed(world, *shown)
    refused("no plan waits", gate.answer, shown[0].id, accept=True)


def object_moved(world: World) -> str:
    world.objects["red"] = standing("red", 0.32, -0.2)
    return "'red' is not seen any more where it stood (the nearest is 20 mm away)"


def neighbour_moved(world: World) -> str:
    world.objects["blue"] = standing("blue", 0.2, 0.24)
    return "'blue' is not seen any more where it stood"


def something_came(world: World) -> str:
    world.objects["green"] = standing("green", 0.3, -0.05)
    return "'green' has come to (0.300, -0.050) m"


def scene_changed(world: World) -> str:
    world.scene += 1
    return "the planning scene has changed from version 1 to 2"


def arm_moved(world: World) -> str:
    world.q["right_joint1"] += 0.05
    return "right_joint1 is 0.050 rad from where the plan begins"


def other_arm_moved(world: World) -> str:
    world.q["left_joint1"] -= 0.05
    return "left_joint1 is 0.050 rad"


@pytest.mark.parametrize(
    "change", [object_moved, neighbour_moved, something_came, scene_changed, arm_moved, other_arm_moved]
)
def test_a_plan_that_the_world_has_overtaken_is_planned_anew_and_asked_about_again(
    change: Callable[[World], str],
) -> None:
    world = World(standing("red", 0.3, -0.2), standing("blue", 0.2, 0.2))
    why: list[str] = []

    def too_late(world: World, status: Status) -> None:
        why.append(change(world))
        confirm(world, status)

    def still_at_rest(world: World, status: Status) -> None:
        assert moves(world) == []
        confirm(world, status)

    shown = watched(world, too_late, still_at_rest)
    world.succeeds(confirm=True)
    first, second = shown
    assert first.id != second.id
    assert is_executed(world, second)
    assert any(f"plan '{first.id}' is not executed: {why[0]}" in note for note in world.notes), world.notes


def test_another_attempt_is_asked_about_again() -> None:
    world = World(standing("red", 0.3, -0.2))
    world.slips = 1
    shown = watched(world)
    assert (world.succeeds(confirm=True).attempts, len(shown)) == (2, 2)
    first, second = shown
    assert first.id != second.id
    done = [part for _, part in (*first.parts[:2], *second.parts)]  # the way home after a failure needs no answer
    assert all(a is b for a, b in zip(world.followed, done, strict=True))
    world = World(standing("red", 0.3, -0.2))
    world.slips = 1
    watched(world, confirm, reject)
    assert world.grasp(confirm=True).code is Code.CANCELLED
    assert len(world.followed) == 2


def test_a_place_that_is_planned_anew_is_asked_about_again(world: World) -> None:
    shown = watched(world)
    report = world.on_report

    def on_report(status: Status) -> None:
        if status.state is State.LIFT:
            world.scene = 2
        report(status)

    world.on_report = on_report
    world.succeeds(confirm=True)
    assert [names(plan) for plan in shown] == [
        ["transfer", "approach", "lift", "carry", "leave"],
        ["carry", "leave"],
    ]
    first, second = shown
    done = [part for _, part in (*first.parts[:3], *second.parts)]
    assert all(a is b for a, b in zip(world.followed, done, strict=True))


def test_each_phase_is_asked_about(world: World) -> None:
    shown = watched(world)
    world.succeeds(phase="pick", confirm=True)
    assert [names(plan) for plan in shown] == [["transfer", "approach", "lift"]]
    assert world.grasp("", phase="place", confirm=True, place=(0.3, -0.3)).success
    assert [names(plan) for plan in shown[1:]] == [["carry", "leave"]]
    assert is_executed(world, *shown)


def test_a_rejected_place_leaves_the_object_in_the_hand(world: World) -> None:
    assert world.grasp(phase="pick").success
    done = len(world.followed)
    watched(world, reject)
    outcome = world.grasp("", phase="place", confirm=True)
    assert (outcome.code, outcome.held) == (Code.CANCELLED, True)
    assert len(world.followed) == done
    assert "right" in world.session.kept


def test_a_cancel_ends_the_wait(world: World) -> None:

    def cancel(world: World, status: Status) -> None:
        world.stopped = Code.CANCELLED

    watched(world, cancel)
    assert world.grasp(confirm=True).code is Code.CANCELLED
    assert moves(world) == []
    refused("no plan waits", world.session.gate.answer, "x", accept=True)


def test_a_dry_run_asks_nobody(world: World) -> None:
    shown = watched(world)
    assert world.grasp(confirm=True, dry_run=True).success
    assert (shown, moves(world)) == ([], [])


@pytest.mark.parametrize("off", [0.003, 0.009])
def test_a_correction_of_the_second_look_is_left_out_or_asked_about(off: float) -> None:
    world = World(standing("red", 0.3, -0.2), near={"enabled": True})
    world.near_off = off
    shown = watched(world)
    assert world.grasp(confirm=True).success
    if off < world.session.context.config.confirm.correction:
        assert is_executed(world, *shown)
        assert len(world.done(PlanGrasp)) == 1
        return
    assert [names(plan)[0] for plan in shown] == ["transfer", "transfer", "carry"]
    first, corrected, place = shown
    done = [part for _, part in (*first.parts[:1], *corrected.parts, *place.parts)]
    assert all(a is b for a, b in zip(world.followed, done, strict=True))


def test_a_correction_that_is_rejected_leaves_the_hand_where_it_is() -> None:
    world = World(standing("red", 0.3, -0.2), near={"enabled": True})
    world.near_off = 0.009
    watched(world, confirm, reject)
    assert world.grasp(confirm=True).code is Code.CANCELLED
    assert [str(part) for part in world.followed] == ["transfer"]


def test_each_part_of_a_hand_over_is_asked_about() -> None:
    world = World(standing("red", 0.3, -0.25))
    world.two_sided = True
    shown = watched(world)
    outcome = world.ask(confirm=True, place=(0.3, 0.25))
    assert (outcome.code, outcome.route) == (Code.OK, "hand_over"), outcome.message
    assert [plan.arm for plan in shown] == ["right", "left"]
    assert is_executed(world, *shown)


def test_a_push_is_asked_about() -> None:
    world = World(standing("red", 0.46, 0.02))
    world.two_sided, world.far = True, 0.44
    shown = watched(world)
    outcome = world.ask(confirm=True)
    assert (outcome.code, outcome.route) == (Code.OK, "push"), outcome.message
    assert [names(plan)[0] for plan in shown] == ["move behind", "transfer"]
    assert world.pushed == 1
    assert is_executed(world, *shown)


@pytest.mark.long
def test_the_controllers_get_the_trajectories_that_were_shown_bit_for_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """On the robot of a campaign: the planner, the motion service and the controllers are the real ones."""
    box = SceneObject(name="box", shape="box", size=(0.045, 0.06, 0.06), color="blue", position=(0.26, -0.2), yaw=0.4)
    task = Task("nominal", 1, Scene(name="bench", objects=(box,)), ())
    trials = Trials(task, SimulatedSenses(depth_noise=False), GraspConfig())
    trials.robot.pass_time(0.3)
    started: list[Motion] = []
    controller = trials.robot.controller("right")
    start = controller.start

    def noted(motion: Motion, begin_ns: int, **how: Any) -> Any:
        started.append(motion)
        return start(motion, begin_ns, **how)

    monkeypatch.setattr(controller, "start", noted)
    report, shown = trials._report, list[ShownPlan]()
    before = dict(trials.robot.states.latest()[1])

    def on_report(status: Status) -> None:
        report(status)
        if status.plan is not None:
            assert trials.robot.states.latest()[1] == pytest.approx(before, abs=1e-3)
            shown.append(status.plan)
            trials.session.gate.answer(status.plan.id, accept=True)

    monkeypatch.setattr(trials, "_report", on_report)
    asked = trials.grasp_task(GraspRequest("blue", place=(0.3, -0.3), confirm=True))
    outcome = trials.link.run(pick_and_place(asked, asked.request))
    assert outcome.success, outcome.message
    (plan,) = shown
    assert names(plan) == ["transfer", "approach", "lift", "carry", "leave"]
    for (name, part), motion in zip(plan.parts, started, strict=False):
        assert isinstance(part, Motion)
        for what in ("t", "q", "v", "a"):
            np.testing.assert_array_equal(getattr(motion, what), getattr(part, what), err_msg=f"{name} {what}")
    assert len(started) == 6  # and the way home
