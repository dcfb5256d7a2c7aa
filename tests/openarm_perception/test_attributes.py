# SPDX-License-Identifier: Apache-2.0
"""Requests in words."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection, kind_of
from openarm_common.errors import Code, OpenArmError
from openarm_perception.detection.attributes import parse, resolve

LABELS = ("red", "green", "blue", "box")


def thing(label: str, kind: str, x: float, y: float, size=(0.05, 0.05, 0.05), score: float = 0.9) -> Detection:
    return Detection(label, score, se3.make(None, (x, y, 0.43)), np.array(size), kind=kind)


THINGS = (
    thing("red", "cube", 0.30, 0.10),
    thing("red", "cube", 0.30, -0.20, score=0.95),
    thing("blue", "can", 0.30, -0.02, (0.066, 0.066, 0.115)),
    thing("green", "cylinder", 0.20, -0.25, (0.05, 0.05, 0.06)),
    thing("box", "box", 0.35, 0.30, (0.05, 0.07, 0.04)),
)


@pytest.mark.parametrize(
    ("text", "index"),
    [
        ("red", 1),  # the most certain
        ("red cube left of the can", 0),
        ("the red cube to the right of the blue can", 1),
        ("can", 2),
        ("blue cylinder", 2),  # a can is a cylinder
        ("the largest object", 2),
        ("the leftmost thing", 4),
        ("smallest box", 1),
        ("pick the cylinder in front of the right red cube", 3),
        ("box left of the red cube left of the can", 4),
        ("biggest box", 4),
        ("red one next to the green cylinder", 1),
        ("anything closest to the box left of the can", 2),
        ("tallest", 2),
    ],
)
def test_requests_by_attributes(text: str, index: int) -> None:
    assert resolve(parse(text, LABELS), THINGS) is THINGS[index]


def test_unknown_words_list_the_known_ones() -> None:
    with pytest.raises(OpenArmError, match=r"'pink' in 'pink cube' is not known; labels: red, green.*cube.*left of"):
        parse("pink cube", LABELS)
    with pytest.raises(OpenArmError, match="names no object"):
        parse("left of the can", LABELS)


def test_what_nothing_fits_is_refused_with_what_there_is() -> None:
    with pytest.raises(OpenArmError, match=r"no object is 'green cube'; in view: red cube, .*blue can") as caught:
        resolve(parse("green cube", LABELS), THINGS)
    assert caught.value.code is Code.NOTHING_DETECTED
    with pytest.raises(OpenArmError, match="'green left of"):
        resolve(parse("green left of the can", LABELS), THINGS)


def test_names_follow_from_measured_extents() -> None:
    assert kind_of("box", (0.050, 0.052, 0.051)) == "cube"
    assert kind_of("box", (0.050, 0.070, 0.051)) == "box"
    assert kind_of("cylinder", (0.066, 0.066, 0.115)) == "can"
    assert kind_of("cylinder", (0.066, 0.066, 0.066)) == "cylinder"
    assert kind_of("sphere", (0.05, 0.05, 0.05)) == "sphere"
    assert kind_of("", (0.05, 0.05, 0.05)) == ""
