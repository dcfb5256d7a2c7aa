# SPDX-License-Identifier: Apache-2.0
"""Which objects a request in words means."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection, gap, kind_of
from openarm_common.errors import Code, OpenArmError
from openarm_common.wanted import describe, fits, select
from tests.refusals import refused, refuses


def thing(color: str, kind: str, x: float, y: float, size=(0.05, 0.05, 0.05), name: str = "") -> Detection:
    return Detection(name, 0.9, se3.make(None, (x, y, 0.43)), np.array(size), kind=kind, color=color)


THINGS = (
    thing("red", "cube", 0.30, -0.20),
    thing("red", "cube", 0.30, 0.10),
    thing("blue", "can", 0.30, -0.02, (0.066, 0.066, 0.115), "Coca Cola"),
    thing("green", "cylinder", 0.20, -0.25, (0.05, 0.05, 0.06)),
    thing("", "box", 0.35, 0.30, (0.05, 0.07, 0.04)),
)


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("", 0),
        ("red", 0),  # the first, as the detector ranked them
        ("cube", 0),
        ("can", 2),
        ("cylinder", 2),  # a can is a cylinder
        ("Coca Cola", 2),
        ("coca-cola", 2),
        ("the BLUE Coca Cola can, please!", 2),
        ("green cylinder", 3),
        ("red cube left of the can", 1),
        ("the red cube to the right of the blue can", 0),
        ("blue cylinder", 2),
        ("the largest object", 2),
        ("the leftmost thing", 4),
        ("smallest box", 0),
        ("pick the cylinder in front of the right red cube", 3),
        ("box left of the red cube left of the Coca Cola", 4),
        ("biggest box", 4),
        ("red one next to the green cylinder", 0),
        ("anything closest to the box left of the can", 2),
        ("red nearest to the box", 1),
        ("tallest", 2),
        ("block", 0),
    ],
)
@pytest.mark.requirement("R-18", "B-18")
def test_requests_by_attributes(text: str, index: int) -> None:
    assert select(text, THINGS)[0] is THINGS[index]


@pytest.mark.parametrize("name", ["Tasse", "Straße", "TEE KANNE", "コーラ", "Ｃｏｌａ", "7-up", "M&M's", "Ä", "🍎"])
@pytest.mark.parametrize("spell", [str, str.upper, str.lower, lambda name: f"the red {name}"])
@pytest.mark.requirement("R-18")
def test_a_class_of_any_spelling_is_found_by_its_name(name, spell) -> None:
    named = thing("red", "box", 0.3, 0.2, name=name)
    assert select(spell(name), (*THINGS, named)) == (named,)


@pytest.mark.requirement("R-18")
def test_a_class_may_be_called_as_a_word_of_the_language_of_requests() -> None:
    shoes = [thing("", "box", 0.3, y, name=name) for name, y in (("left shoe", -0.1), ("right shoe", 0.1), ("A", 0.2))]
    assert select("left shoe", shoes) == (shoes[0],)
    assert select("the right shoe", shoes) == (shoes[1],)
    assert select("a", shoes) == (shoes[2],)
    with pytest.raises(OpenArmError):
        select("shoe", shoes)  # a name counts as a whole
    odd = replace(shoes[0], name="???")
    assert select("???", (*shoes, odd)) == (odd,)


@pytest.mark.parametrize("text", ["pink", "pink cube", "green cube", "cola", "the", "left of the can", "red can", "!"])
@pytest.mark.requirement("R-18", "B-58")
def test_what_nothing_fits_is_refused_with_what_there_is(text) -> None:
    with refuses(Code.UNKNOWN_OBJECT) as caught:
        select(text, THINGS)
    there = "Coca Cola (blue, can, cylinder), box, green (cylinder), red (cube, box)"
    assert caught.value.message.endswith(f"in view; in view: {there}")


def test_the_part_of_a_request_that_fits_nothing_is_named() -> None:
    refused("no 'the pear' in view", select, "red left of the pear", [replace(one) for one in THINGS])
    refused("no 'green left of the can' in view", select, "green left of the can", THINGS)
    assert refused("nothing is in view", select, "red", ()).code is Code.NOTHING_DETECTED


def test_words_fit_an_object_without_regard_to_others() -> None:
    assert fits("", THINGS[0])
    assert fits("red cube", THINGS[0])
    assert not fits("red can", THINGS[0])
    assert describe(()) == "nothing"


def test_kinds_follow_from_measured_extents() -> None:
    assert kind_of("box", (0.050, 0.052, 0.051)) == "cube"
    assert kind_of("box", (0.050, 0.070, 0.051)) == "box"
    assert kind_of("cylinder", (0.066, 0.066, 0.115)) == "can"
    assert kind_of("cylinder", (0.066, 0.066, 0.066)) == "cylinder"
    assert kind_of("sphere", (0.05, 0.05, 0.05)) == "sphere"
    assert kind_of("", (0.05, 0.05, 0.05)) == ""


@pytest.mark.requirement("R-17", "R-18")
def test_the_easiest_lies_under_nothing_and_has_room() -> None:
    under = thing("red", "box", 0.30, 0.0)
    over = replace(thing("blue", "box", 0.0, 0.0), T_base_object=se3.make(None, (0.31, 0.0, 0.48)))
    beside = thing("green", "box", 0.30, 0.06)
    alone = thing("", "box", 0.20, 0.3)
    hidden = replace(thing("white", "box", 0.2, -0.3), measured=False)
    in_view = (hidden, under, beside, over, alone)
    assert select("easiest anything", in_view) == select("", in_view, "easiest") == (over, alone, beside, under, hidden)
    assert select("largest thing", (under, over), "easiest")[0] is over
    assert select("thing", (beside, over, alone, under), "easiest_left") == (alone, over, beside, under)
    assert select("thing", (beside, over, alone, under), "easiest_right")[-1] is under
    assert select("easiest red", (under, over)) == (under,)


@pytest.mark.parametrize(("x", "y", "yaw", "expected"), [
    (0.10, 0.0, 0.0, 0.06), (0.10, 0.0, np.pi / 4.0, 0.1 - 0.02 - 0.02 * 2**0.5), (0.05, 0.05, 0.0, 0.01 * 2**0.5),
    (0.0, 0.0, 0.3, 0.0), (0.03, 0.01, 0.0, 0.0),
])  # fmt: skip
def test_the_gap_between_boxes_is_that_of_their_outlines(x: float, y: float, yaw: float, expected: float) -> None:
    a = Detection("a", 0.9, se3.make(None, (0.0, 0.0, 0.4)), np.array([0.04, 0.04, 0.04]))
    b = Detection("b", 0.9, se3.make(se3.rot_z(yaw), (x, y, 0.5)), np.array([0.04, 0.04, 0.1]))
    assert gap(a, b) == pytest.approx(expected, abs=1e-9)
    assert gap(b, a) == pytest.approx(expected, abs=1e-9)


def test_boxes_that_cross_have_no_gap() -> None:
    a = Detection("a", 0.9, se3.make(None, (0.0, 0.0, 0.4)), np.array([0.2, 0.02, 0.04]))
    b = Detection("b", 0.9, se3.make(None, (0.0, 0.0, 0.4)), np.array([0.02, 0.2, 0.04]))
    assert gap(a, b) == 0.0
