# SPDX-License-Identifier: Apache-2.0
"""`openarm_hardware` before the emulated motors of the simulated robot: what the bridge offers, down to the frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import Trigger

from openarm_common.ros.actions import latest
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND
from openarm_hardware.ros.node import OpenArmHardware
from openarm_sim_bridge.ros.node import MujocoBridge
from tests.nodes.conftest import Bench as BridgeBench

#: The robot, its node and this test are one process, none of them in real time.
PATIENT = {
    "motors.silent": 250,
    "motors.stale": 5.0,
    "motors.timeout": 5.0,
    "motors.ramp": 0.2,
    "motors.tracking": 1.5,
    "trajectory.path_tolerance": 1.0,
    "trajectory.goal_time": 20.0,
    "stale_after": 5.0,
}
START = [0.05, 0.05, 0.0, 0.05, 0.0, 0.0, 0.0]


class Bench(BridgeBench):
    """The bridge as motors, and the node before it."""

    def __init__(self, ros, folder: Path) -> None:
        made = {"profile": "openarm", "controllers": "motors", "scene": "empty", "images": False}
        self.ros = ros
        self.node = ros.start(MujocoBridge, **made)
        self.joints, self.joint_arrivals = list[JointState](), list[float]()
        ros.node.create_subscription(JointState, "/joint_states", self._on_joints, QOS_COMMAND)
        self.reports: list[DiagnosticArray] = self.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
        values = {**PATIENT, "emulated": True, "calibrations": str(folder), "dynamics_seed": 1}
        self.hardware = ros.start(OpenArmHardware, **values)
        ros.spin_until(
            lambda: self.report().get("right_phase") == "FOLLOWING" and self.level() == b"\0", what="arms up"
        )

    def level(self) -> bytes:
        return self._status().level if self._status() else b"\2"

    def _status(self):
        found = [s for m in self.reports for s in m.status if s.name.startswith("openarm_hardware")]
        return found[-1] if found else None

    def message(self) -> str:
        return self._status().message if self._status() else ""

    def report(self) -> dict[str, str]:
        """The newest values of the node on /diagnostics."""
        status = self._status()
        return {value.key: value.value for value in status.values} if status else {}


@pytest.fixture
def bench(ros, tmp_path: Path) -> Bench:
    return Bench(ros, tmp_path)


@pytest.mark.long
@pytest.mark.requirement("A-25", "B-55", "P-22")
def test_the_arms_move_and_the_hand_closes_as_on_the_bridge(bench: Bench) -> None:
    goal = bench.goal((0.5, START), (2.5, [q + 0.6 * (i == 1) for i, q in enumerate(START)]))
    _, result = bench.follow(goal)
    answer = bench.ros.result(result).result
    assert answer.error_code == 0, answer.error_string
    bench.spin_sim(0.5)
    assert bench.arm[1] == pytest.approx(0.65, abs=0.02)
    newest = bench.joints[-1]
    shoulder = newest.name.index(bench.ARM[1])
    assert abs(newest.effort[shoulder]) > 1.0  # the weight of the arm, in the motor's reply
    bench.grip(0.03)
    assert bench.position(bench.FINGER) == pytest.approx(0.03, abs=0.002)
    values = bench.report()
    assert float(values["period_p50_ms"]) > 0.0
    assert values[bench.ARM[0]].startswith("status 0x1, 35 °C")
    assert {"frames_lost", "bus_errors", "scheduling", "cycles_left_out", "left_phase"} <= values.keys()
    assert (Path(bench.hardware.config.calibrations) / "last_posture_emulated.json").is_file()


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("B-55")
def test_joint_states_keep_the_rate_of_control(bench: Bench) -> None:
    had = len(bench.joints)
    bench.ros.spin_until(lambda: len(bench.joints) > had + 100, what="joint states")
    steps = np.diff([stamp_to_ns(message.header.stamp) for message in bench.joints[-100:]])
    assert 8e6 < np.median(steps) < 14e6


@pytest.mark.requirement("R-08", "R-10")
def test_a_motor_s_fault_is_reported_by_name_refuses_goals_and_is_reset_when_it_is_gone(bench: Bench) -> None:
    bench.inject("motor_fault", f"{{kind: error, joint: {bench.ARM[2]}, value: 12}}")
    bench.ros.spin_until(lambda: bench.report().get("right_phase") == "DAMPED", what="the arm sinks")
    assert bench.ARM[2] in bench.message()
    assert "rotor too hot" in bench.message()
    assert bench.report()["left_phase"] == "HELD"
    assert bench.level() != b"\0"
    _, refused = bench.follow(bench.goal((1.0, START)))
    assert "rotor too hot" in bench.ros.result(refused).result.error_string
    bench.clear()
    bench.call(Trigger, "/openarm_hardware/reset")
    bench.ros.spin_until(lambda: bench.level() == b"\0", what="the arms are up again")


@pytest.mark.requirement("R-08")
def test_a_motor_that_lost_a_turn_is_said_and_its_joint_is_where_it_is(bench: Bench) -> None:
    before = bench.arm
    limits = bench.collect(Float64, "/right_joint_trajectory_controller/fastest", latest())
    bench.inject("motor_fault", f"{{kind: turn, joint: {bench.ARM[0]}, value: 1}}")
    bench.ros.spin_until(lambda: bench.report().get("right_phase") == "DAMPED", what="the reading jumps")
    bench.call(Trigger, "/openarm_hardware/reset")
    bench.ros.spin_until(lambda: "(a turn) was added" in bench.report().get(bench.ARM[0], ""), what="the turn is said")
    bench.ros.spin_until(lambda: bench.level() == b"\0", what="the arms are up again")
    assert bench.arm == pytest.approx(before, abs=0.4)  # it sank until it was reset
    bench.ros.spin_until(lambda: bool(limits), what="the limit of the first motion")
    assert limits[-1].data == pytest.approx(0.3)
    up = [q + 0.2 * (i == 1) for i, q in enumerate(bench.arm)]
    _, result = bench.follow(bench.goal((0.5, up)))
    assert "its limit is 0.30 until this arm has arrived once" in bench.ros.result(result).result.error_string
    _, result = bench.follow(bench.goal((1.0, up)))
    assert bench.ros.result(result).result.error_code == 0
    bench.ros.spin_until(lambda: limits[-1].data == float("inf"), what="the end of the limit")
    kept = json.loads((Path(bench.hardware.config.calibrations) / "last_posture_emulated.json").read_text())
    assert kept["positions"][bench.ARM[0]] == pytest.approx(before[0], abs=0.4)


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("R-08", "R-10")
def test_a_fault_of_a_motor_ends_the_goal_by_name_and_is_reset_when_it_is_gone(bench: Bench) -> None:
    _, begun = bench.follow(bench.goal((0.5, START)))
    bench.grip(0.03)
    assert bench.ros.result(begun).result.error_code == 0
    assert bench.arm == pytest.approx(START, abs=0.02)
    assert bench.position(bench.FINGER) == pytest.approx(0.03, abs=0.002)
    _, result = bench.follow(bench.goal((60.0, [q + 0.6 * (i == 1) for i, q in enumerate(START)])))
    bench.inject("motor_fault", f"{{kind: error, joint: {bench.ARM[2]}, value: 12}}")
    answer = bench.ros.result(result).result
    assert bench.ARM[2] in answer.error_string
    assert "rotor too hot" in answer.error_string
    bench.ros.spin_until(lambda: bench.report().get("right_phase") == "DAMPED", what="the arm sinks")
    bench.clear()
    bench.call(Trigger, "/openarm_hardware/reset")
    bench.ros.spin_until(lambda: bench.level() == b"\0", what="the arms are up again")
    here = [max(0.01, float(q)) if i == 3 else float(q) for i, q in enumerate(bench.arm)]
    _, result = bench.follow(bench.goal((0.5, here)))
    assert bench.ros.result(result).result.error_code == 0


@pytest.mark.long
@pytest.mark.requirement("R-08")
def test_the_emergency_stop_holds_the_motors_until_reset(bench: Bench) -> None:
    goal = bench.goal((0.5, START), (6.0, [q + 0.8 * (i == 1) for i, q in enumerate(START)]))
    _, result = bench.follow(goal)
    bench.spin_sim(2.0)
    assert bench.call(Trigger, "/stop").success
    assert "emergency stop" in bench.ros.result(result).result.error_string
    bench.ros.spin_until(lambda: bench.report().get("right_phase") == "HELD", what="the motors hold")
    bench.spin_sim(0.5)
    held = bench.arm
    bench.spin_sim(0.5)
    assert bench.arm == pytest.approx(held, abs=0.01)
    assert bench.call(Trigger, "/openarm_hardware/reset").success
    bench.ros.spin_until(lambda: bench.level() == b"\0", what="the arms follow again")
    assert bench.arm == pytest.approx(held, abs=0.03)
