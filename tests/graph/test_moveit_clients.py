# SPDX-License-Identifier: Apache-2.0
"""pymoveit2, unmodified, before the graph `motion` of three robots: every program of examples/moveit_programs.py."""

from __future__ import annotations

import json
import subprocess
import sys
from typing import Any

import pytest

from openarm_evaluation.judging.ros.observer import Observer
from tests.graph.conftest import ROOT

pytest.importorskip(
    "pymoveit2", reason="needs pymoveit2: .venv/bin/uv pip install --require-hashes -r requirements-moveit.lock"
)
pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.requirement("R-28")]

#: What is said when rclpy loses an answer that comes while another thread still sends (ros2/rclpy#1123).
_LOST = ("unexpected goal response", "list.remove(x): x not in list")
#: Names of the library's own preset; of the robot's SRDF.
_NAMES = {
    "panda": ("--preset", "panda", "--posture", "ready"),
    "openarm_v1": ("--group", "right_arm", "--gripper", "right_gripper", "--posture", "hands_up"),
    "openarm_v2": ("--group", "left_arm", "--gripper", "left_gripper", "--posture", "hands_up"),
}


@pytest.mark.parametrize("robot", _NAMES)
def test_every_program_of_the_library_does_what_it_should(start_graph: Any, robot: str) -> None:
    up = start_graph("motion", "--moveit", "--robot", robot)
    up.wait_ready()
    command = [sys.executable, str(ROOT / "examples" / "moveit_programs.py"), "--json", *_NAMES[robot]]

    for _ in range(3):
        done = subprocess.run(command, env=up.env, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
        if not any(text in done.stderr for text in _LOST):
            break

    up.stop()
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [row for row in rows if not row["ok"]] == [], done.stderr[-2000:]
    assert len(rows) == 17
    assert done.returncode == 0


@pytest.mark.requirement("B-47", "B-50")
def test_the_state_machine_of_the_example_places_the_cube_by_ground_truth(start_graph: Any) -> None:
    up = start_graph("sim", "--moveit")
    up.wait_ready()
    place = (0.36, -0.20)
    command = [sys.executable, str(ROOT / "examples" / "moveit_client.py"), "red", "--place", *map(str, place)]

    with Observer(up.domain) as observer:
        done = subprocess.run(command, env=up.env, cwd=ROOT, capture_output=True, text=True, timeout=240, check=False)
        assert done.returncode == 0, done.stdout + done.stderr[-2000:]
        observer.forget()
        observer.wait(lambda: len(observer.track("red_cube")) > 5 or None, 10.0, "ground truth")
        x, y, _ = observer.track("red_cube")[-1].p_world

    up.stop()
    assert abs(x - place[0]) < 0.02
    assert abs(y - place[1]) < 0.02
