# SPDX-License-Identifier: Apache-2.0
"""Degraded mode in a running graph: the eyes die for good while an arm is on its way."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.scene.scene import load_scene
from openarm_evaluation.judging.ros.observer import Observer
from openarm_evaluation.judging.trial import wait_scene
from openarm_grasp.ros.client import GraspClient
from openarm_motion.ros.client import MotionClient
from tests.graph.asking import Asked

pytestmark = [pytest.mark.graph, pytest.mark.slow, pytest.mark.alone]

#: The graph `sim`, whose eyes are not started again, without what a grasp does not need.
BLINDABLE = """
extends: sim
only: [mujoco_bridge, calibration_publisher, detector, wrist_detector, motion, grasp]
nodes:
  detector: {restart: {policy: never}}
  wrist_detector: {restart: {policy: never}}
"""


def test_a_detector_that_dies_during_a_grasp_leaves_the_arm_at_rest_and_the_service_says_so(
    start_graph: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Degraded: the grasp ends with a code that names the eyes, the arm obeys, the next request is refused at once."""
    graph = tmp_path / "blindable.yaml"
    graph.write_text(BLINDABLE)
    up = start_graph(str(graph))
    pids = {name: node["pid"] for name, node in up.wait_ready()["nodes"].items()}
    monkeypatch.setenv("ROS_DOMAIN_ID", str(up.domain))
    with Observer(up.domain) as observer, GraspClient() as client, MotionClient() as motion:
        wait_scene(observer, load_scene("demo"), 0)
        request = Asked(observer, lambda: client.pick("red"))
        request.wait_state("MOVE_TO_PREGRASP")
        for eye in ("detector", "wrist_detector"):
            os.kill(pids[eye], signal.SIGKILL)
        result = request.result(timeout=90.0)
        assert not result.success
        assert result.code in (Code.STALE_DATA, Code.NOT_READY), f"{result.code}: {result.message}"
        assert "detector" in result.message

        where = observer.track("red_cube")
        assert float(np.abs(where[-1].p_world - where[0].p_world).max()) < 0.002, "the hand went down blind"
        assert motion.move_to_named("right", "home").success, "the arm is under control"
        began = time.monotonic()
        again = client.pick("red")
        assert again.code == Code.NOT_READY, f"{again.code}: {again.message}"
        assert "/detections_3d" in again.message
        assert time.monotonic() - began < 6.0
    record = up.record()
    assert record["health"] == "degraded, without detector, wrist_detector"
    assert {name for name, node in record["nodes"].items() if node["state"] == "ready"} == {
        "mujoco_bridge",
        "calibration_publisher",
        "motion",
        "grasp",
    }
    assert up.stop() == 0
