# SPDX-License-Identifier: Apache-2.0
"""The whole suite in lock-step: the same run twice, and the end of a run in which a node does not answer (N-18)."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = [pytest.mark.graph, pytest.mark.slow]

SCRIPT = ("--set", "script.dry_run=true", "--set", "script.rest=0.3", "--set", "script.begin=0.5")


def run_script(start_graph: Callable[..., Any], result: Path) -> dict[str, Any]:
    up = start_graph("lockstep", "--set", f"script.result={result}", *SCRIPT)
    deadline = time.monotonic() + 60.0
    while not result.exists() and up.process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.05)
    assert result.exists(), up.output.read_text()
    assert up.stop() == 0, up.output.read_text()
    return json.loads(result.read_text())


@pytest.mark.requirement("N-18")
def test_the_same_seed_is_the_same_run_also_beside_a_busy_process(
    start_graph: Callable[..., Any], tmp_path: Path
) -> None:
    first = run_script(start_graph, tmp_path / "first.json")
    assert first["answers"][0]["code"] == "OK", first
    assert first["joint_states"]["n"] > 80
    busy = subprocess.Popen([sys.executable, "-c", "while True: pass"])
    try:
        second = run_script(start_graph, tmp_path / "second.json")
    finally:
        busy.kill()
        busy.wait()
    assert second == first


def test_a_node_that_does_not_answer_ends_the_run_with_its_name(
    start_graph: Callable[..., Any], tmp_path: Path
) -> None:
    graph = tmp_path / "small.yaml"
    graph.write_text(
        "extends: sim_only\n"
        "lockstep: {participants: [calibration_publisher]}\n"
        "nodes:\n"
        "  mujoco_bridge:\n"
        "    module: openarm_sim_bridge.ros.node\n"
        "    params: {images: false, speed: 1.0, barrier.timeout: 1.0}\n"
    )
    up = start_graph(str(graph))
    nodes = up.wait_ready()["nodes"]
    pid, log = nodes["calibration_publisher"]["pid"], Path(nodes["mujoco_bridge"]["log"])
    deadline = time.monotonic() + 30.0
    while "begins" not in log.read_text():  # before, the bridge waits for whoever has not come yet
        assert time.monotonic() < deadline, "the lock-step does not begin"
        time.sleep(0.05)
    os.kill(pid, signal.SIGSTOP)
    try:
        deadline = time.monotonic() + 60.0
        while "failed" not in up.output.read_text() and time.monotonic() < deadline:
            time.sleep(0.05)
    finally:
        os.kill(pid, signal.SIGCONT)
    assert up.process.wait(60.0) == 1
    assert "calibration_publisher did not answer tick" in up.output.read_text()
