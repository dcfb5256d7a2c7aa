# SPDX-License-Identifier: Apache-2.0
"""What requests leave in the hands; the answer to two requests."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.zeros import HandReach
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import Box, propose
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, PairOutcome, Proof
from openarm_grasp.requests.states import Hand, State
from openarm_grasp.requests.task import Grasp, GraspSession
from openarm_grasp.robot.interface import PlanGrasp
from openarm_grasp.strategies.run import Run
from tests.openarm_grasp.scripted import GoHome, Grip, World, standing
from tests.refusals import refused, refuses


def kept(arm: str, label: str) -> Grasp:
    T = np.eye(4)
    T[:3, 3] = (0.26, 0.2, 0.425)
    target = Detection(label, 1.0, T, np.full(3, 0.05))
    return Grasp(
        arm, Sighting(target, (), 0), propose(target, GraspConfig(), RobotDescription.load().hand(arm).parts)[0], ()
    )


@pytest.fixture
def session(world) -> GraspSession:
    return world.session


@pytest.mark.requirement("P-01")
def test_what_either_hand_holds_is_placed_by_label_or_arm(session) -> None:
    red, blue = kept("right", "red"), kept("left", "blue")
    session.kept = {"right": red, "left": blue}
    asked = {("red", "auto"): red, ("blue", "auto"): blue, ("", "right"): red, ("", "left"): blue, ("", ""): red}
    found = {key: session.to_place(GraspRequest(key[0], arm=key[1], phase="place")) for key in asked}
    assert found == asked
    with refuses(Code.INVALID_ARGUMENT, "right hand that holds 'red', the left hand that holds 'blue'"):
        session.to_place(GraspRequest("green", phase="place"))


@pytest.mark.requirement("P-01")
def test_a_full_hand_next_to_the_one_that_places_stays_where_it_is(world) -> None:
    assert world.grasp("red", phase="pick").success
    world.session.kept["left"] = kept("left", "blue")
    world.log.clear()
    assert world.grasp("", phase="place", arm="right").success
    assert all("left" not in call.arms for call in world.done(GoHome))
    assert list(world.session.kept) == ["left"]


@pytest.mark.requirement("P-01")
def test_a_hand_that_holds_nothing_any_more_is_forgotten(world) -> None:
    assert world.grasp("red", phase="pick").success
    refused("right hand still holds 'red'", world.session.check_hands, world, GraspRequest("blue"))
    world.session.check_hands(world, GraspRequest("blue", dry_run=True))
    world.gap = 0.0
    world.session.check_hands(world, GraspRequest("blue"))
    assert not world.session.kept


@pytest.mark.requirement("P-01")
def test_what_is_nearly_as_wide_as_the_hand_opens_is_still_held(world) -> None:
    assert world.grasp("red", phase="pick").success
    opening = 2.0 * world.robot.description.hand("right").parts.opening
    world.session.kept["right"] = replace(world.session.kept["right"], closed=opening - 0.0035)
    world.gap = opening - 0.003  # within the tolerance of an open hand
    assert world.is_open("right")
    refused("right hand still holds 'red'", world.session.check_hands, world, GraspRequest("blue"))
    world.gap = opening
    world.session.check_hands(world, GraspRequest("blue"))
    assert not world.session.kept


def test_a_dry_run_of_a_place_moves_nothing_and_the_hand_keeps_its_object(world) -> None:
    assert world.grasp("red", phase="pick").success
    before = len(world.log)
    outcome = world.grasp("", phase="place", dry_run=True)
    assert (outcome.code, outcome.attempts, outcome.held) == (Code.OK, 0, True)
    assert outcome.message.startswith("can be done: place spot")
    assert {type(call).__name__ for _, call in world.log[before:]} == {"Observe", "PlanPlace"}
    assert list(world.session.kept) == ["right"]


def test_a_place_goes_on_with_what_it_holds_after_frames_that_are_too_old(world) -> None:
    assert world.grasp("red", phase="pick").success
    world.frame_age = 9.0
    world.on_report = lambda status: setattr(world, "frame_age", 0.0 if "s old" in status.reason else world.frame_age)
    world.succeeds("", phase="place")
    assert [status.state.value for status in world.status].count("DETECT") == 2


@pytest.mark.parametrize(
    ("first", "second", "kind"),
    [
        ("done", "done", "SUCCESS"),
        ("done", "refused", "PARTIAL"),
        ("failed", "held", "PARTIAL"),
        ("failed", "refused", "FAILED"),
        ("refused", "refused", "REFUSED"),
        ("done", "cancelled", "CANCELLED"),
    ],
)
@pytest.mark.requirement("P-02")
def test_the_outcome_of_two_is_given_in_one_word(first: str, second: str, kind: str) -> None:
    proof = Proof(Verdict(Code.OK, "held"), Verdict(Code.OK, "at its place"))
    ends = {
        "done": GraspOutcome(Code.OK, "placed", "a", attempts=1, proof=proof),
        "refused": GraspOutcome(Code.UNREACHABLE, "too far", "a"),
        "failed": GraspOutcome(Code.GRASP_MISSED, "closed on nothing", "a", attempts=3),
        "held": GraspOutcome(Code.PLACE_FAILED, "in the hand", "a", attempts=1, held=True),
        "cancelled": GraspOutcome(Code.CANCELLED, "cancelled", "a", attempts=1),
    }
    for one, other in ((first, second), (second, first)):
        outcome = PairOutcome((ends[one], ends[other]), Code.OK if one == other == "done" else Code.NO_PLAN, "")
        assert (outcome.kind, outcome.success) == (kind, kind == "SUCCESS")
    assert PairOutcome((), Code.BUSY, "").kind == "REFUSED"


BOX = Box("target/blue", np.eye(4), np.array([0.05, 0.04, 0.06]))


@pytest.mark.parametrize(
    ("gap", "effort", "box", "use_effort", "found"),
    [
        (0.0, -30.0, None, True, ""),  # closed on nothing, pressing on itself
        (0.0, -30.0, BOX, True, ""),  # the planner is wrong: it fell
        (0.088, 30.0, BOX, True, ""),  # wide open
        (0.045, 0.0, None, True, ""),  # half open, by command
        (0.045, 1.5, BOX, True, ""),  # noise of an effort
        (0.045, -30.0, BOX, True, "blue"),
        (0.045, -30.0, None, True, "something 45 mm wide"),
        (0.020, -30.0, BOX, True, "something 20 mm wide"),  # too narrow for it
        (0.045, 0.0, BOX, False, "blue"),  # a driver without efforts: the planner decides
        (0.045, 0.0, None, False, ""),
    ],
)
@pytest.mark.requirement("P-01")
def test_a_session_that_begins_with_a_full_hand_says_so_and_never_claims_an_empty_one(
    gap, effort, box, use_effort, found
) -> None:
    world = World(standing("red", 0.26, -0.2), held={"use_effort": use_effort})
    world.gap, world.effort, world.carried = gap, effort, {} if box is None else {"right": box}
    world.aperture = lambda arm: gap if arm == "right" else 0.0
    if not found:
        assert world.ask("red").code is not Code.NOT_READY
        assert not world.session.kept
        return
    with refuses(Code.NOT_READY, f"the right hand .*{found}.*`openarm grasp release --arm right`"):
        world.ask("red")
    assert not world.done(Grip)
    assert list(world.session.kept) == (["right"] if found == "blue" else [])


STOPPED = HandReach(closed=0.0016, opened=0.038, effort=6.4, learned="2026-11-30T01:00:00+00:00")


@pytest.mark.parametrize(
    ("gap", "effort", "reach", "refusal"),
    [
        (0.0032, -6.4, None, "6 N on something 3 mm wide.*if it is empty.*`openarm hardware learn-hand --arm right`"),
        (0.0032, -6.4, STOPPED, ""),  # what this hand reads closed on nothing
        (0.0039, -6.4, STOPPED, ""),
        (0.0060, -20.0, STOPPED, "20 N on something 6 mm wide"),  # but far firmer
        (0.0100, -20.0, STOPPED, "something 10 mm wide"),
        (0.0080, -16.0, STOPPED, r"if it is empty.*\(it went from 3.2 to 76.0 mm, learned 2026-11-30"),  # other fingers
    ],
)
@pytest.mark.requirement("P-01")
def test_a_closed_hand_is_compared_with_what_this_hand_reads_closed_on_nothing(gap, effort, reach, refusal) -> None:
    world = World(standing("red", 0.26, -0.2))
    world.gap, world.effort, world.learned = gap, effort, reach
    world.aperture = lambda arm: gap if arm == "right" else 0.0
    if refusal:
        with refuses(Code.NOT_READY, refusal):
            world.ask("red")
        return
    assert world.ask("red").code is not Code.NOT_READY
    refused("no hand holds anything", lambda: world.session.release(world, "").send(None))


def test_the_arm_of_a_release_is_the_one_that_holds_and_must_be_said_when_both_do(world) -> None:
    def release(arm: str = "") -> str:
        with pytest.raises(StopIteration) as end:
            world.session.release(world, arm).send(None)
        return end.value.value

    for arm, code in (("middle", Code.INVALID_ARGUMENT), ("", Code.NOT_READY)):
        assert refused(None, release, arm).code is code
    world.session.kept = {arm: kept(arm, label) for arm, label in (("right", "red"), ("left", "blue"))}
    refused("say which", release)
    assert release("left") == "the left hand is open; it held 'blue'"
    world.gap = 0.0
    assert release() == "the right hand is open; it held 'red'"
    assert [grip.arm for grip in world.done(Grip)] == ["left", "right"]
    assert not world.session.kept


# --- requests of two arms at the same time
def next_to(world, label: str, arm: str = "right") -> Run:
    """Another request that is being carried out, and is at nothing yet."""
    request = GraspRequest(label, arm=arm)
    return Run(world.task(request), request, None)


def end(run: Run, x: float, y: float) -> None:
    """End a request that has placed something."""
    run.state, run.tried = State.RESET, 1
    proof = Proof(Verdict(Code.OK, "held"), Verdict(Code.OK, "at its place"))
    run.end(GraspOutcome(Code.OK, "placed", "a", attempts=1, place_position=(x, y, 0.4), proof=proof))


def test_a_request_never_takes_what_another_one_is_at_or_puts_down(world) -> None:
    other = next_to(world, "red")
    other.seen_at = world.objects["red"].p_base
    world.ends(Code.UNKNOWN_OBJECT, "besides 1 that must stay where they are", "red")
    assert world.succeeds("anything").label == "blue"
    other.seen_at = None
    other.place_target = SimpleNamespace(position=world.objects["red"].p_base)
    world.ends(Code.UNKNOWN_OBJECT, "besides 1 that must stay where they are", "red")


def test_what_another_hand_is_about_to_lift_is_no_obstacle(world) -> None:
    other = next_to(world, "red")
    other.findings.sighting = Sighting(replace(world.objects["red"], id="red"), (), 0)
    for hand, expected in ((Hand.FREE, {"detected/red"}), (Hand.AT_OBJECT, set())):
        other.hand = hand
        world.log.clear()
        world.grasp("blue", dry_run=True)
        found = {box.id.rpartition("_")[0] for plan in world.done(PlanGrasp) for box in plan.obstacles}
        assert found == expected


def test_a_request_never_takes_what_another_one_has_placed_since_it_began(world) -> None:
    other, (x, y, _) = next_to(world, "red"), world.objects["red"].p_base

    def on_report(status) -> None:
        if status.state is State.DETECT and other in world.session.runs:
            end(other, x, y)

    world.on_report = on_report
    world.ends(Code.UNKNOWN_OBJECT, "besides 1 that must stay where they are", "red")
    world.succeeds("red")  # a request that comes afterwards may
    assert world.session.runs == []


@pytest.mark.parametrize("first", ["red", "blue"])
def test_who_leaves_what_one_arm_placed_leaves_what_the_other_placed_meanwhile_unheard_of(world, first) -> None:
    spots = {label: tuple(one.p_base[:2]) for label, one in world.objects.items()}
    runs = {label: next_to(world, label, arm) for label, arm in (("red", "right"), ("blue", "left"))}
    for label in sorted(runs, key=lambda name: name != first):
        world.pass_time(1.0)
        end(runs[label], *spots[label])
    for label in runs:
        world.ends(Code.UNKNOWN_OBJECT, "besides 2 that must stay", "anything", exclude_near=(spots[label],))
    world.pass_time(1.0)
    later = next_to(world, "green")
    world.pass_time(1.0)
    end(later, 0.5, 0.0)
    assert world.succeeds("anything", exclude_near=((0.5, 0.0),)).success


def test_of_the_easiest_an_arm_by_name_takes_the_outermost_on_its_side_first(worlds) -> None:
    for arm, expected in (("left", "blue"), ("right", "red"), ("auto", "green")):
        world = worlds(standing("green", 0.26, 0.0), standing("blue", 0.26, 0.3), standing("red", 0.26, -0.3))
        assert world.succeeds("anything", arm=arm, selection="easiest").label == expected


@pytest.mark.requirement("P-01", "P-21")
def test_an_arm_by_name_works_next_to_a_full_hand_that_it_neither_opens_nor_moves(world) -> None:
    world.session.kept["left"] = kept("left", "blue")
    world.session.partly_open = lambda robot, arm: arm == "left"
    for arm in ("auto", "left"):
        refused("left hand still holds 'blue'", world.session.check_hands, world, GraspRequest("red", arm=arm))
    assert world.ask("red", arm="right").success
    assert all("left" not in call.arms for call in world.done(GoHome))
    assert {call.arm for call in world.done(Grip)} == {"right"}
    assert list(world.session.kept) == ["left"]


def test_what_the_other_hand_holds_unknown_is_no_reason_to_refuse_an_arm_by_name() -> None:
    world = World(standing("red", 0.26, -0.2))
    world.effort, world.session.partly_open = -30.0, lambda robot, arm: arm == "left"
    refused("the left hand presses", world.ask, "red")
    assert world.ask("red", arm="right").code is not Code.NOT_READY
    refused("the left hand presses", world.ask, "red", arm="left")
