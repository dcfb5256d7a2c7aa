# SPDX-License-Identifier: Apache-2.0
"""Eyes and hands under supervisors of their own, in one domain; then the hands lose their eyes."""

from __future__ import annotations

import json
import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_evaluation.judging.ros.observer import Observer

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
    with Observer(control.domain) as observer, ThreadPoolExecutor() as pool:
        observer.wait(lambda: observer.joints() or None, 20.0, "joint states")
        doctor = pool.submit(control.openarm, "doctor", "--json")
        refused = control.openarm("pick", "blue", "--json")
        findings = json.loads(doctor.result().stdout)["findings"]
        positions = np.array([list(joints.values()) for _, joints in observer.joints()])
    answer = json.loads(refused.stdout)
    assert refused.returncode == 1
    assert answer["code"] in BLIND, answer
    assert "/detections_3d" in answer["message"]
    assert np.abs(positions - positions[0]).max() < 0.01
    assert "node detector" in [finding["name"] for finding in findings if finding["level"] == "error"]
    assert vision.stop() == 0
    assert control.stop() == 0
