# SPDX-License-Identifier: Apache-2.0
"""The pitfalls that robots of this kind are known for, on one page; each has a regression test that carries its id."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parent

PITFALLS = {
    "A-19": "one physics step a control tick: the world runs at a fifth of its speed",
    "A-21": "a command written into the positions: joints jump through contacts",
    "A-22": "joints found by their number: a free object in front shifts them",
    "A-23": "a command of some joints, or of unknown ones, ends the program",
    "A-29": "depth asked of the model file, which knows no such thing, instead of the renderer",
    "A-32": "intrinsics of another camera: targets are off by tens of centimetres",
    "A-39": "hand-eye calibration called with other arguments than it takes",
    "A-41": "poses that hardly turn: a calibration that is off and says nothing",
    "A-47": "millimetres taken for metres in a depth image",
    "A-48": "depth that is too near, or invalid, taken for points",
    "A-56": "a map that only ever marks: what has gone stays as a ghost",
    "A-61": "the corner of a box taken for its centre; no object taken for a fault of the program",
    "A-69": "the wrong number of a contact taken for its force, or the wrong one of its bodies for the object",
    "A-70": "an object that falls on the way is not looked for again",
    "A-71": "a command that was sent taken for a grasp that was done",
    "B-30": "a colour image, a depth image and intrinsics of different sizes used together",
    "B-31": "a formula for a camera that looks level used for one that looks down",
    "B-33": "a frame without a transform used all the same",
    "B-38": "boxes of the network's input taken for boxes of the image",
    "B-41": "a planner's interface that this ROS does not have",
    "B-44": "roll, pitch and yaw of zero taken for a hand that looks down",
    "B-48": "a pre-grasp so near that the path's tolerance lets the hand touch the object",
    "B-57": "a sleep taken for the end of a motion",
    "B-58": "a plan or a detection that fails ends everything",
    "B-60": "a frame without a pose at its stamp used with another",
    "B-61": "the newest pose of a moving camera taken for that of its image",
    "B-69": "frames queued while nobody needs them: the next grasp acts on old ones",
    "P-33": "a detection of long ago acted on",
}


def requirements_of_tests() -> set[str]:
    """Ids of the requirements that tests carry as markers, without running any test."""
    return {
        argument.value
        for path in TESTS.rglob("test_*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Call) and ast.unparse(node.func) == "pytest.mark.requirement"
        for argument in node.args
        if isinstance(argument, ast.Constant) and isinstance(argument.value, str)
    }


@pytest.fixture(scope="module")
def tested() -> set[str]:
    return requirements_of_tests()


@pytest.mark.parametrize("pitfall", PITFALLS)
@pytest.mark.requirement("N-22")
def test_each_pitfall_has_a_regression_test(tested: set[str], pitfall: str) -> None:
    assert pitfall in tested, f"no test carries {pitfall}: {PITFALLS[pitfall]}"
