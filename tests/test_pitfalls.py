# SPDX-License-Identifier: Apache-2.0
"""The pitfalls that robots of this kind are known for, on one page; each has a regression test that carries its id."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

TESTS = Path(__file__).parent

PITFALLS = {
    "a19": "one physics step a control tick: the world runs at a fifth of its speed",
    "a21": "a command written into the positions: joints jump through contacts",
    "a22": "joints found by their number: a free object in front shifts them",
    "a23": "a command of some joints, or of unknown ones, ends the program",
    "a29": "depth asked of the model file, which knows no such thing, instead of the renderer",
    "a32": "intrinsics of another camera: targets are off by tens of centimetres",
    "a39": "hand-eye calibration called with other arguments than it takes",
    "a41": "poses that hardly turn: a calibration that is off and says nothing",
    "a47": "millimetres taken for metres in a depth image",
    "a48": "depth that is too near, or invalid, taken for points",
    "a56": "a map that only ever marks: what has gone stays as a ghost",
    "a61": "the corner of a box taken for its centre; no object taken for a fault of the program",
    "a69": "the wrong number of a contact taken for its force, or the wrong one of its bodies for the object",
    "a70": "an object that falls on the way is not looked for again",
    "a71": "a command that was sent taken for a grasp that was done",
    "b30": "a colour image, a depth image and intrinsics of different sizes used together",
    "b31": "a formula for a camera that looks level used for one that looks down",
    "b33": "a frame without a transform used all the same",
    "b38": "boxes of the network's input taken for boxes of the image",
    "b41": "a planner's interface that this ROS does not have",
    "b44": "roll, pitch and yaw of zero taken for a hand that looks down",
    "b48": "a pre-grasp so near that the path's tolerance lets the hand touch the object",
    "b57": "a sleep taken for the end of a motion",
    "b58": "a plan or a detection that fails ends everything",
    "b60": "a frame without a pose at its stamp used with another",
    "b61": "the newest pose of a moving camera taken for that of its image",
    "b69": "frames queued while nobody needs them: the next grasp acts on old ones",
    "p33": "a detection of long ago acted on",
}


def names_of_tests() -> set[str]:
    """Names of all test functions, without running any."""
    found: set[str] = set()
    for path in TESTS.rglob("test_*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        found |= {n.name for n in ast.walk(tree) if isinstance(n, ast.FunctionDef) and n.name.startswith("test_")}
    return found


@pytest.fixture(scope="module")
def named() -> set[str]:
    """Parts of the names of all tests."""
    return {part for name in names_of_tests() for part in name.split("_")}


@pytest.mark.parametrize("pitfall", PITFALLS)
def test_n22_each_pitfall_has_a_regression_test_named_after_it(named: set[str], pitfall: str) -> None:
    assert pitfall in named, f"no test carries {pitfall}: {PITFALLS[pitfall]}"
