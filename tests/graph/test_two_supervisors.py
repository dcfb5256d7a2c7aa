# SPDX-License-Identifier: Apache-2.0
"""Eyes and hands under supervisors of their own, in one domain; then the hands lose their eyes."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path
from typing import Any

import pytest

from openarm_common.errors import Code

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.alone]

BLIND = {Code.NOTHING_DETECTED, Code.STALE_DATA, Code.NOT_READY, Code.TIMEOUT}


@pytest.mark.requirement("A-05")
def test_eyes_and_hands_started_apart_grasp_as_one_and_without_eyes_the_arm_holds(
    start_graph: Any, tmp_path: Path
) -> None:
    """The nodes of `sim` by two supervisors; a detector that is lost for good leaves a graph that refuses by name."""
    eyes = tmp_path / "eyes.yaml"
    eyes.write_text("extends: vision\nname: eyes\nnodes: {detector: {restart: {policy: never}}}\n")
    control = start_graph("control")
    vision = start_graph(str(eyes), joining=control)
    control.wait_ready()
    detector = vision.wait_ready()["nodes"]["detector"]["pid"]
    done = control.openarm("pick", "red", "--json", timeout=200.0)
    assert done.returncode == 0, done.stdout + done.stderr

    os.kill(detector, signal.SIGKILL)
    deadline = time.monotonic() + 20.0
    while vision.record()["health"] != "degraded, without detector":
        assert time.monotonic() < deadline, vision.record()
    before = arms(control)
    refused = control.openarm("pick", "blue", "--json")
    answer = json.loads(refused.stdout)
    assert refused.returncode == 1
    assert answer["code"] in BLIND, answer
    assert "/detections_3d" in answer["message"]
    assert max(abs(now - then) for now, then in zip(arms(control), before, strict=True)) < 0.01
    sick = [f for f in json.loads(control.openarm("doctor", "--json").stdout)["findings"] if f["level"] == "error"]
    assert "node detector" in [finding["name"] for finding in sick]
    assert vision.stop() == 0
    assert control.stop() == 0


def arms(up: Any) -> list[float]:
    """Positions of all joints, rad and m."""
    heard = up.openarm("topic", "echo", "/joint_states", "-n", "1", "--json")
    return json.loads(heard.stdout)["messages"][0]["position"]
