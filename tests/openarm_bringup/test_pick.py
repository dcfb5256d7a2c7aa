# SPDX-License-Identifier: Apache-2.0
"""`openarm pick --dry-run`: what is printed of the ways to grasp."""

from __future__ import annotations

import json

from openarm_bringup.commands import pick
from openarm_common.errors import Code
from openarm_grasp.options import Option

OPTIONS = (
    Option("red/x+/tilt0", "left", 0.05, {"tilt": -0.0, "width": 0.05}, 0.5, Code.OK, "chosen"),
    Option(
        "red/x-/tilt0", "left", 0.05, {"tilt": 0.0, "width": 0.05}, code="IN_COLLISION", message="[hand] meets blue"
    ),
    Option("red/y", "left", code=Code.TOO_WIDE, message="90 mm wide"),
)


def test_each_way_to_grasp_has_a_line_with_parts_margin_and_reason() -> None:
    head, chosen, refused, wide, _ = pick._weighed(OPTIONS).splitlines()
    assert head.split() == ["way", "to", "grasp", "arm", "score", "tilt", "width", "margin"]
    assert chosen.split() == ["red/x+/tilt0", "left", "+0.05", "+0.00", "+0.05", "29°", "chosen"]
    assert refused.endswith("IN_COLLISION: [hand] meets blue")
    assert wide.split() == ["red/y", "left", "TOO_WIDE:", "90", "mm", "wide"]
    assert pick._weighed(()) == ""


def test_json_has_no_number_for_a_margin_that_is_not_known() -> None:
    chosen, refused, _ = json.loads(json.dumps([pick._fared(option) for option in OPTIONS], allow_nan=False))
    assert (chosen["limit_margin"], chosen["code"]) == (0.5, "OK")
    assert (refused["limit_margin"], refused["parts"]) == (None, {"tilt": 0.0, "width": 0.05})
