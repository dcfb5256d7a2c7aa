# SPDX-License-Identifier: Apache-2.0
"""Pick and place with a scripted robot: what it does when all goes well, what it sees, how it plans."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from openarm_bringup import load_graph
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_evaluation.campaign.in_process_robot import InProcessRobot
from openarm_grasp.config import LEAST_SCALE, GraspConfig
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.states import State
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace
from openarm_motion.service.requests import ApproachAnswer, PlanApproachRequest
from tests.openarm_grasp.scripted import Follow, GoHome, Grip, MoveLinear, Observe
from tests.refusals import refused


# --- success
@pytest.mark.requirement("B-06", "B-57")
def test_a_grasp_goes_through_all_states_in_order(world):
    outcome = world.succeeds()
    assert (outcome.arm, outcome.attempts, outcome.label) == ("right", 1, "red")
    order = [s for i, s in enumerate(world.states) if i == 0 or s is not world.states[i - 1]]
    assert order == [*list(State)[1:], State.IDLE]
    assert np.linalg.norm(world.objects["red"].p_base[:2] - outcome.place_position[:2]) < 1e-9
    assert outcome.duration == pytest.approx((world.t_ns - 1_000_000_000) * 1e-9)


@pytest.mark.requirement("B-51")
def test_the_hand_opens_on_the_way_to_the_pregrasp(world):
    real, together = world.follow_and_grip, []

    async def follow_and_grip(arm, trajectory, what, how, aperture):
        together.append((trajectory, how))
        await real(arm, trajectory, what, how, aperture)

    world.follow_and_grip = follow_and_grip
    world.grasp()
    assert together == [("transfer", "open")]


@pytest.mark.requirement("B-52", "B-53", "B-54")
def test_pauses_are_those_of_the_graph_and_real_robots_have_some(worlds, box):
    params = load_graph("real").nodes["grasp"].params
    timing = {name: params[f"timing.{name}"] for name in ("pause_at_grasp", "after_close")}
    world = worlds(box("red", 0.26, -0.2), timing=timing)
    world.grasp()
    (close,) = world.times(world.grips(opening=False))
    (arrive,) = world.times(world.follows_path("approach"))
    (lift,) = world.times(world.follows_path("lift"))
    assert close - (arrive + 1.0) == pytest.approx(0.5)  # the motion takes 1 s
    assert lift - (close + 0.6) == pytest.approx(0.2)  # the fingers take 0.6 s


def test_a_request_has_its_own_speed_or_that_of_the_configuration(world):
    for asked, taken in ((0.25, 0.25), (0.0, 1.0)):
        world.succeeds(velocity_scale=asked)
        assert world.velocity_scale == taken
    for wrong in (-0.1, 1e-4, 1.5, float("nan")):
        check = GraspRequest("red", velocity_scale=wrong).check
        assert refused("expected 0.001 to 1", check, ("left", "right")).code is Code.INVALID_ARGUMENT


def test_no_speed_falls_below_the_least_that_is_accepted(world):
    """Each failure halves it, and a push takes a quarter."""
    world.slips = 2
    assert world.succeeds(velocity_scale=LEAST_SCALE).attempts == 3
    assert world.velocity_scale == LEAST_SCALE
    asked = list[PlanApproachRequest]()

    async def plan_approach(request, stopped) -> ApproachAnswer:
        asked.append(request)
        return ApproachAnswer(OpenArmError(Code.NO_PLAN, "no way"), "no way")

    robot: Any = SimpleNamespace(description=RobotDescription.load(), states=None, together=None)
    robot.motion = SimpleNamespace(plan_approach=plan_approach)
    link = InProcessRobot(robot, GraspConfig())
    for scale in (1.0, 2.0 * LEAST_SCALE):
        link.velocity_scale = scale
        refused("no way", link.run, link.plan(PlanGrasp("left", (), (), (), velocity_scale=0.25)))
    assert [one.scale for one in asked] == [0.25, LEAST_SCALE]


@pytest.mark.requirement("B-71")
def test_the_hand_opens_only_before_the_grasp_and_at_the_place(world):
    world.grasp()
    gripper = [(e.what, e.position) for e in world.done(Grip)]
    assert gripper == [("open", 0.044), ("close", 0.0), ("release", 0.044)]


@pytest.mark.requirement("B-01")
def test_a_moved_object_is_grasped_where_it_is(worlds, box):
    for x, y in ((0.2, -0.1), (0.3, -0.35), (0.22, 0.31)):
        world = worlds(box("red", x, y))
        assert world.grasp().success
        (plan,) = world.done(PlanGrasp)
        assert plan.candidates[0].T_base_tcp[:2, 3] == pytest.approx((x, y))


@pytest.mark.requirement("B-70")
def test_twenty_cycles_unattended(world):
    for _ in range(20):
        assert world.grasp().success
    assert [e.arms for e in world.done(GoHome)] == 20 * [("left",), ("right",), ("right",)]


def test_a_place_that_is_asked_for_is_used(world):
    assert world.succeeds(place=(0.3, -0.35, 0.0)).place_position == pytest.approx((0.3, -0.35, 0.4))


@pytest.mark.requirement("R-18", "A-70")
@pytest.mark.parametrize("words", ["", "cube", "leftmost cube", "cube left of the blue"])
def test_the_retry_keeps_to_the_same_object_whatever_the_words_fit_by_then(worlds, box, words):
    """The first attempt misses; then another one is first, further left, and the one that was asked for has moved."""
    red, blue = (replace(box(label, 0.26, y), kind="cube") for label, y in (("red", -0.2), ("blue", -0.35)))
    world = worlds(red, blue, box("green", 0.26, -0.5))
    world.slips = 1

    def swap(call):
        if isinstance(call, Grip) and call.position == 0.0 and len(world.done(PlanGrasp)) == 1:
            left, right = (replace(box(label, 0.26, y), kind="cube") for label, y in (("blue", 0.1), ("red", -0.32)))
            world.objects = {"blue": left, "red": right, "green": world.objects["green"]}

    world.faults.append(swap)
    outcome = world.grasp(words)
    assert (outcome.code, outcome.label, outcome.attempts) == (Code.OK, "red", 2), outcome.message


@pytest.mark.requirement("R-18", "B-18", "B-58")
@pytest.mark.parametrize(
    ("words", "label"),
    [
        ("cola", "cola"),
        ("can", "cola"),
        ("red can", "cola"),
        ("cylinder", "cola"),
        ("red cube", "Tasse"),
        ("TASSE", "Tasse"),
    ],
)
def test_an_object_is_asked_for_by_class_colour_shape_or_several_words(worlds, box, words, label):
    can = replace(box("cola", 0.26, -0.2), color="red", kind="can")
    world = worlds(can, replace(box("Tasse", 0.26, 0.2), color="red", kind="cube"))
    outcome = world.grasp(words)
    assert (outcome.code, outcome.label) == (Code.OK, label), outcome.message
    outcome = world.ends(Code.UNKNOWN_OBJECT, label="blue can")
    # the scripted hand puts down what has no further attributes
    assert outcome.message.startswith("no 'blue can' in view; in view: ")


@pytest.mark.requirement("R-18")
def test_what_is_held_is_asked_for_by_any_of_its_attributes(worlds, box):
    world = worlds(replace(box("cola", 0.26, -0.2), color="red", kind="can"))
    assert world.grasp("can", phase="pick").success
    with pytest.raises(OpenArmError, match=r"asked to place 'blue'.* holds 'cola'"):
        world.grasp("blue", phase="place")
    assert world.grasp("red can", phase="place").success


def test_others_are_obstacles_and_the_target_may_be_touched(world):
    world.grasp()
    plan = world.done(PlanGrasp)[0]
    assert [b.id for b in plan.obstacles] == ["detected/blue_0"]
    assert [box.id for box in plan.target] == ["target/red"]


def test_dry_run_plans_both_and_moves_nothing(world):
    outcome = world.succeeds(dry_run=True)
    assert outcome.attempts == 0
    assert "can be done" in outcome.message
    assert not world.done(Follow) + world.done(Grip) + world.done(GoHome) + world.done(MoveLinear)
    (place,) = world.done(PlanPlace)
    assert place.after == "lift"
    assert [b.id for b in place.ignore_regions] == ["target/red"], "the map still shows it where it stands"


# --- seeing
@pytest.mark.requirement("B-58")
def test_an_unknown_object_is_refused_with_what_is_in_view(world):
    assert world.ends(Code.UNKNOWN_OBJECT, label="mug").message == "no 'mug' in view; in view: blue (box), red (box)"
    assert world.states.count(State.DETECT) == 3
    assert State.TRANSFORM not in world.states


def test_an_empty_table_is_named(worlds):
    assert worlds().grasp().code is Code.NOTHING_DETECTED


@pytest.mark.requirement("B-58")
def test_an_object_that_comes_into_view_is_waited_for(worlds, box):
    world = worlds(box("blue", 0.26, 0.2))

    def arrive(status):
        if status.state is State.IDLE:
            world.objects["red"] = box("red", 0.26, -0.2)

    world.on_report = arrive
    assert world.grasp().success


@pytest.mark.requirement("P-33")
def test_a_stale_detection_is_not_acted_on(world):
    world.frame_age = 0.6
    world.ends(Code.STALE_DATA, "0.60 s old")
    assert not world.done(PlanGrasp)


def test_no_frames_end_the_grasp_at_once(world):
    world.fail(lambda e: isinstance(e, Observe), Code.STALE_DATA)
    world.ends(Code.STALE_DATA)
    assert len(world.done(Observe)) == 1


@pytest.mark.requirement("B-33")
def test_no_transform_means_no_motion(world):
    world.fail(lambda e: isinstance(e, Observe), Code.NO_TRANSFORM)
    world.ends(Code.NO_TRANSFORM)
    assert not world.done(Follow)


def test_too_wide_is_refused_with_width_and_limit(worlds, box):
    outcome = worlds(box("red", 0.26, -0.2, size=0.09)).grasp()
    assert outcome.code is Code.TOO_WIDE
    assert "90 mm" in outcome.message
    assert "78 mm" in outcome.message


# --- planning
@pytest.mark.requirement("B-58")
def test_a_failed_plan_looks_again(world):
    world.fail(lambda e: isinstance(e, PlanGrasp), Code.NO_PLAN, times=1)
    outcome = world.succeeds()
    assert world.states.count(State.PLAN) == 2
    assert outcome.attempts == 1


def test_out_of_reach_names_the_reason_and_the_nearest_arm(world):
    world.fail(lambda e: isinstance(e, PlanGrasp), Code.UNREACHABLE)
    outcome = world.ends(Code.UNREACHABLE, "right arm gets within 200 mm")
    assert len(world.done(PlanGrasp)) == 4  # plan_attempts, each also on shorter lines
    assert {one.candidates[0].id.endswith("/short") for one in world.done(PlanGrasp)} == {False, True}
    assert outcome.attempts == 0


def test_in_the_overlap_the_second_arm_is_tried(worlds, box):
    world = worlds(box("red", 0.26, -0.05))
    world.fail(lambda e: isinstance(e, PlanGrasp) and e.arm == "right", Code.NO_PLAN)
    assert world.succeeds().arm == "left"


def test_a_place_out_of_reach_is_refused_before_anything_moves(world):
    world.fail(lambda e: isinstance(e, PlanPlace), Code.UNREACHABLE)
    world.ends(Code.UNREACHABLE, "could grasp, but not place", place=(0.75, -0.5))
    assert not world.done(Follow)


def test_a_place_off_the_table_is_refused(world):
    assert world.grasp(place=(2.0, 0.0)).code is Code.INVALID_ARGUMENT
