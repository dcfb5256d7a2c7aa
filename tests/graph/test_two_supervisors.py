# SPDX-License-Identifier: Apache-2.0
"""Eyes and hands under supervisors of their own, in one domain; then the hands lose their eyes in a grasp."""

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
from openarm_grasp.ros.client import GraspClient
from openarm_motion.ros.client import MotionClient
from tests.graph.asking import Asked

pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.alone]

EYES = """
extends: vision
name: eyes
nodes:
  detector: {restart: {policy: never}}
  wrist_detector: {restart: {policy: never}}
"""


@pytest.mark.requirement("A-05")
def test_eyes_and_hands_started_apart_grasp_as_one_and_without_eyes_the_arm_holds(
    start_graph: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The nodes of `sim` by two supervisors; detectors that are lost for good leave a graph that refuses by name."""
    eyes = tmp_path / "eyes.yaml"
    eyes.write_text(EYES)
    quick = ("grasp.velocity_scale=1.0", "flight_recorder.image_rate=1.0")
    control = start_graph("control", *(word for setting in quick for word in ("--set", setting)))
    vision = start_graph(str(eyes), joining=control)
    control.wait_ready()
    nodes = vision.wait_ready().nodes
    done = control.openarm("pick", "red", "--json", timeout=200.0)
    assert done.returncode == 0, done.stdout + done.stderr

    monkeypatch.setenv("ROS_DOMAIN_ID", str(control.domain))
    with (
        Observer(control.domain) as observer,
        GraspClient() as client,
        MotionClient() as motion,
        ThreadPoolExecutor() as pool,
    ):
        observer.wait(lambda: observer.track("blue_can") or None, 20.0, "ground truth")
        request = Asked(observer, lambda: client.pick("blue"))
        request.wait_state("MOVE_TO_PREGRASP")
        for name in ("detector", "wrist_detector"):
            os.kill(nodes[name].pid, signal.SIGKILL)
        result = request.result(timeout=90.0)
        assert not result.success
        assert result.code in (Code.STALE_DATA, Code.NOT_READY), f"{result.code}: {result.message}"
        assert "detector" in result.message
        where = observer.track("blue_can")
        assert float(np.abs(where[-1].p_world - where[0].p_world).max()) < 0.002, "the hand went down blind"
        for arm in ("left", "right"):
            assert motion.move_to_named(arm, "home").success, "the arms are under control"

        deadline = time.monotonic() + 40.0
        while vision.record()["health"] != "degraded, without detector, wrist_detector":
            assert time.monotonic() < deadline, vision.record()
        assert result.recording, "a failed grasp leaves a recording"
        recording = Path(result.recording)
        while not recording.is_dir():  # it is written after the answer
            assert time.monotonic() < deadline, f"{recording} was not written"
            time.sleep(0.1)
        observer.forget()
        observer.wait(lambda: observer.joints() or None, 20.0, "joint states")
        doctor = pool.submit(control.openarm, "doctor", "--json")
        began = time.monotonic()
        again = client.pick("blue")
        assert time.monotonic() - began < 11.0, "limits.ready_timeout is 8 s"
        assert again.code == Code.NOT_READY, f"{again.code}: {again.message}"
        assert "/detections_3d" in again.message
        findings = json.loads(doctor.result().stdout)["findings"]
        positions = np.array([list(joints.values()) for _, joints in observer.joints()])
        assert len(positions) > 50
    assert np.abs(positions - positions[0]).max() < 0.01
    assert "node detector" in [finding["name"] for finding in findings if finding["level"] == "error"]
    listed = [finding for finding in findings if finding["name"] == "recordings" and finding["level"] == "note"]
    assert recording.name in listed[0]["observed"], "what the failed grasp has left"
    states = {name: node["state"] for name, node in vision.record()["nodes"].items()}
    assert {name for name, state in states.items() if state != "ready"} == {"detector", "wrist_detector"}
    vision.process.send_signal(signal.SIGINT)
    assert control.stop() == 0
    assert vision.process.wait(timeout=30.0) == 0
