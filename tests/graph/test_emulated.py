# SPDX-License-Identifier: Apache-2.0
"""The graph `real` with its emulation: grasp, motion, hardware node, frames, motors, physics, drawn cameras."""

from __future__ import annotations

import json
import time
from typing import Any

import numpy as np
import pytest
from openarm_interfaces.srv import ClearFaults, InjectFault

from openarm_common.robot.description import RobotDescription
from openarm_evaluation.judging.ros.observer import Observer
from openarm_grasp.ros.client import GraspClient
from openarm_motion.ros.client import MotionClient
from tests.graph.asking import Asked

pytestmark = [pytest.mark.graph, pytest.mark.long, pytest.mark.alone]


#: Images a second in which objects are detected next to motors in real time that a grasp needs; a camera makes 30.
ENOUGH_HZ = 4.0


@pytest.fixture(scope="module")
def up(start_graph: Any) -> Any:
    """The graph, ready, which lets a busy machine detect and move late; motors go on in real time on any machine."""
    late = ("motors.silent=250", "trajectory.path_tolerance=0.3", "motors.tracking=0.5")
    settings = ("grasp.detect.max_age=3.0", *(f"openarm_hardware.{setting}" for setting in late))
    graph = start_graph("real", "--emulate", *(word for setting in settings for word in ("--set", setting)))
    graph.wait_ready()
    measured = graph.openarm("topic", "hz", "/detections_3d", "--domain", str(graph.domain), "--json")
    assert measured.returncode == 0, measured.stdout + measured.stderr
    rate = json.loads(measured.stdout)["rate_hz"]
    if rate < ENOUGH_HZ:
        pytest.skip(f"next to motors in real time this machine detects in {rate:.0f} images a second of 30")
    return graph


@pytest.mark.requirement("R-10", "A-25")
def test_an_object_is_placed_through_frames_motors_and_physics(
    up: Any, observer: Observer, client: GraspClient
) -> None:
    observer.wait(lambda: observer.truth(), 20.0, "ground truth")
    result = client.pick("red", arm="right")
    assert result.success, f"{result.code}: {result.message}"
    place = observer.track("red_cube")[-1].p_world
    assert np.hypot(*(place[:2] - result.place_position[:2])) < 0.02


@pytest.mark.requirement("R-08")
def test_a_motor_that_fails_in_the_lift_is_named_and_after_a_reset_the_arm_goes_on(
    up: Any, observer: Observer, client: GraspClient
) -> None:
    joint = RobotDescription.load().arm_joints("right")[3]
    observer.wait(lambda: observer.truth(), 20.0, "ground truth")
    request = Asked(observer, lambda: client.pick("green", arm="right"))
    request.wait_state("LIFT")
    fault = InjectFault.Request(name="motor_fault", parameters=f"{{kind: error, joint: {joint}, value: 12}}")
    answer = client.call(InjectFault, "/sim/inject_fault", fault)
    assert answer.success, answer.message
    result = request.result(60.0)
    assert not result.success
    assert joint in result.message
    assert "rotor too hot" in result.message
    client.call(ClearFaults, "/sim/clear_faults", ClearFaults.Request())
    done = up.openarm("stop", "--reset")
    assert "Traceback" not in done.stdout + done.stderr

    deadline = time.monotonic() + 60.0  # the arms come up first
    while not (opened := client.release("right")).success:
        assert time.monotonic() < deadline, opened.message
    with MotionClient() as motion:
        while not (home := motion.move_to_named("right", "home", hand_empty=True)).success:
            assert time.monotonic() < deadline, home.message
