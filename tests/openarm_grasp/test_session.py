# SPDX-License-Identifier: Apache-2.0
"""What requests leave in the hands; the answer to two requests."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import propose
from openarm_grasp.strategies.pair import check_pair
from openarm_grasp.strategies.request import GraspOutcome, GraspRequest, PairOutcome, Proof
from openarm_grasp.strategies.task import Grasp, GraspSession
from tests.openarm_grasp.scripted import GoHome


def kept(arm: str, label: str) -> Grasp:
    T = np.eye(4)
    T[:3, 3] = (0.26, 0.2, 0.425)
    target = Detection(label, 1.0, T, np.full(3, 0.05))
    return Grasp(arm, Sighting(target, (), 0), propose(target, GraspConfig())[0], ())


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
    with pytest.raises(OpenArmError, match="right hand that holds 'red', the left hand that holds 'blue'") as error:
        session.to_place(GraspRequest("green", phase="place"))
    assert error.value.code is Code.INVALID_ARGUMENT


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
    with pytest.raises(OpenArmError, match="right hand still holds 'red'"):
        world.session.check_hands(world, GraspRequest("blue"))
    world.session.check_hands(world, GraspRequest("blue", dry_run=True))
    world.gap = 0.0
    world.session.check_hands(world, GraspRequest("blue"))
    assert not world.session.kept


def test_a_dry_run_of_a_place_moves_nothing_and_the_hand_keeps_its_object(world) -> None:
    assert world.grasp("red", phase="pick").success
    before = len(world.log)
    outcome = world.grasp("", phase="place", dry_run=True)
    assert (outcome.code, outcome.attempts, outcome.held) == (Code.OK, 0, True)
    assert outcome.message.startswith("can be done: place spot")
    assert {type(call).__name__ for _, call in world.log[before:]} == {"Observe", "ToBase", "PlanPlace"}
    assert list(world.session.kept) == ["right"]


def test_a_place_goes_on_with_what_it_holds_after_frames_that_are_too_old(world) -> None:
    assert world.grasp("red", phase="pick").success
    world.frame_age = 9.0
    world.on_report = lambda status: setattr(world, "frame_age", 0.0 if "s old" in status.reason else world.frame_age)
    outcome = world.grasp("", phase="place")
    assert outcome.success, outcome.message
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


def test_two_requests_for_what_may_be_one_object_are_refused() -> None:
    def refusal(*pair: GraspRequest) -> str:
        with pytest.raises(OpenArmError) as error:
            check_pair((pair[0], pair[1]))
        assert error.value.code is Code.INVALID_ARGUMENT
        return error.value.message

    red, blue = GraspRequest("red"), GraspRequest("blue")
    check_pair((red, blue))
    assert "'red' is asked for twice" in refusal(red, red)
    for pair in product((red, GraspRequest("")), repeat=2):
        if pair != (red, red):
            assert "need a label each" in refusal(*pair)
    here, near, away = (GraspRequest("red", object_at=(0.26, y)) for y in (0.2, 0.11, 0.0))
    check_pair((here, away))
    assert "90 mm apart, expected more than 100 mm" in refusal(here, near)
    assert "phase 'pick' is of one alone" in refusal(red, GraspRequest("blue", phase="pick"))
    assert "valid: auto, left, right" in refusal(red, GraspRequest("blue", arm="middle"))
