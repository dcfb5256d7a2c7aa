# SPDX-License-Identifier: Apache-2.0
"""`openarm pick`: requests in words, and what a dry run prints of the candidates."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import psutil
import pytest

from openarm_bringup.commands import connect, pick
from openarm_bringup.ros import object_client
from openarm_bringup.supervision import runs
from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.planning.options import Option

OPTIONS = (
    Option("red/x+/tilt0", "left", 0.05, {"tilt": -0.0, "width": 0.05}, 0.5, Code.OK, "chosen"),
    Option(
        "red/x-/tilt0", "left", 0.05, {"tilt": 0.0, "width": 0.05}, code="IN_COLLISION", message="[hand] meets blue"
    ),
    Option("red/y", "left", code=Code.TOO_WIDE, message="90 mm wide"),
)


def test_each_candidate_has_a_line_with_parts_margin_and_reason() -> None:
    head, chosen, refused, wide, _ = pick._options_table(OPTIONS).splitlines()
    assert head.split() == ["candidate", "arm", "score", "tilt", "width", "margin"]
    assert chosen.split() == ["red/x+/tilt0", "left", "+0.05", "+0.00", "+0.05", "29°", "chosen"]
    assert refused.endswith("IN_COLLISION: [hand] meets blue")
    assert wide.split() == ["red/y", "left", "TOO_WIDE:", "90", "mm", "wide"]
    assert pick._options_table(()) == ""


def test_words_select_the_object_that_is_there(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []

    def find(requests: Sequence[str]) -> list[Detection]:
        asked.extend(requests)
        return [Detection("red", 0.9, se3.make(None, (0.3, -0.2, 0.42)), np.full(3, 0.05), kind="box")]

    monkeypatch.setattr(object_client, "find", find)
    labels, spots = pick._resolve(("blue", "red cube left of the can"), ((0.1, 0.2), None))
    assert (labels, spots) == (["blue", "red"], [(0.1, 0.2), (0.3, -0.2)])
    assert asked == ["red cube left of the can"]
    assert pick._resolve(("blue",), (None,)) == (("blue",), (None,))
    with pytest.raises(OpenArmError, match="leave --at out"):
        pick._resolve(("red cube",), ((0.3, -0.2),))


def test_a_graph_without_grasping_is_named_with_one_that_has_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("ROS_DOMAIN_ID", "7")
    me = psutil.Process()

    def run(*nodes: str) -> None:
        states = {node: runs.NodeRecord(state="ready") for node in nodes}
        record = runs.RunRecord(
            graph="motion",
            pid=me.pid,
            pid_created=me.create_time(),
            domain=7,
            discovery="localhost",
            run_dir="",
            started="",
            nodes=states,
        )
        runs.write_record(record)

    def ask() -> str:
        with pytest.raises(OpenArmError) as refused, connect.requires_node("grasp", "sim"):
            raise OpenArmError(Code.NOT_READY, "no action")
        assert refused.value.code == Code.NOT_READY
        return refused.value.message

    assert ask() == "no action"  # nothing runs here; elsewhere, who knows
    run("motion", "grasp")
    assert ask() == "no action"
    run("motion")
    assert ask().startswith("what runs here in domain 7 (motion) has no node `grasp`")
    assert "`openarm up sim`" in ask()


def test_json_has_no_number_for_a_margin_that_is_not_known() -> None:
    chosen, refused, _ = json.loads(json.dumps([pick._option_row(option) for option in OPTIONS], allow_nan=False))
    assert (chosen["limit_margin"], chosen["code"]) == (0.5, "OK")
    assert (refused["limit_margin"], refused["parts"]) == (None, {"tilt": 0.0, "width": 0.05})
