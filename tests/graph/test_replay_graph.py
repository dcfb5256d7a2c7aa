# SPDX-License-Identifier: Apache-2.0
"""A bag in place of the robot: nodes to the right of the bridge can't tell."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from vision_msgs.msg import Detection3DArray

from openarm_bringup.bags import golden
from tests.graph.asking import until, user

BAG = Path(__file__).parents[1] / "data" / "demo_pick"
pytestmark = [pytest.mark.graph, pytest.mark.long]


def test_a_replayed_bag_is_detected_as_the_robot_was(start_graph: Any) -> None:
    up = start_graph("replay")
    up.wait_ready()
    found: list[tuple[float, float]] = []

    def take(message: Detection3DArray) -> None:
        for detection in message.detections:
            if detection.results[0].hypothesis.class_id == "blue":
                found.append((detection.bbox.center.position.x, detection.bbox.center.position.y))

    command = [sys.executable, "-m", "openarm_bringup.cli", "replay", str(BAG), "--rate", "2"]
    with user(up.domain) as node:
        node.create_subscription(Detection3DArray, "/detections_3d", take, 10)
        with subprocess.Popen(command, env=up.env, stdout=subprocess.PIPE, text=True) as replay:
            assert until(node, replay.poll, lambda code: code is not None) == 0
            said = replay.stdout.read()
    assert "left to the graph" in said
    assert "/detections_3d" in said
    assert len(found) >= 5
    expected = golden.read(BAG / "golden.json")
    for axis, values in zip("xy", zip(*found, strict=True), strict=True):
        recorded = expected[f"detection/overhead/blue/{axis}_mm"]["value"] * 1e-3
        assert all(value == pytest.approx(recorded, abs=0.003) for value in values)
    assert up.stop() == 0
