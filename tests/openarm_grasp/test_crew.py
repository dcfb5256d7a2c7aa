# SPDX-License-Identifier: Apache-2.0
"""Two machines and what their requests leave in the hands; the answer to two requests."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Table
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.observation import Detection
from openarm_grasp.planning.candidates import propose
from openarm_grasp.strategy.crew import Crew
from openarm_grasp.strategy.effects import GraspOutcome, GraspRequest
from openarm_grasp.strategy.memory import Kept, Surroundings
from openarm_grasp.strategy.pair import PairOutcome, check_pair


@pytest.fixture
def crew() -> Crew:
    return Crew(Surroundings(GraspConfig(), Table(), {"left": (0.0, 0.2), "right": (0.0, -0.2)}))


def kept(arm: str, label: str) -> Kept:
    T = np.eye(4)
    T[:3, 3] = (0.26, 0.2, 0.425)
    target = Detection(label, 1.0, T, np.full(3, 0.05))
    return Kept(arm, target, propose(target, GraspConfig())[0])


def test_what_either_hand_holds_is_placed_by_the_machine_that_knows_it(crew: Crew) -> None:
    first, second = crew.machines
    second.kept = kept("left", "blue")
    assert crew.serving(GraspRequest("red")) is first
    assert crew.serving(GraspRequest("", phase="place")) is second
    assert crew.full_hands_beside(second) == ()
    first.kept = kept("right", "red")
    asked = {
        ("red", "auto"): first,
        ("blue", "auto"): second,
        ("", "right"): first,
        ("", "left"): second,
        ("", ""): first,
        ("green", "auto"): first,
    }
    assert {key: crew.serving(GraspRequest(key[0], arm=key[1], phase="place")) for key in asked} == asked
    assert crew.full_hands_beside(second) == ("right",)
    assert crew.full_hands_beside(first) == ("left",)


def test_both_machines_watch_the_same_camera(crew: Crew) -> None:
    first, second = crew.machines
    assert first.drift is second.drift


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
def test_the_outcome_of_two_is_told_in_one_word(first: str, second: str, kind: str) -> None:
    ends = {
        "done": GraspOutcome(Code.OK, "placed", "a", attempts=1),
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
