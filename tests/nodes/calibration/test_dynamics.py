# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate dynamics`: servos are identified and stored, and the bridge carries the arms by them."""

from __future__ import annotations

import os
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from typing import ClassVar

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from openarm_interfaces.action import MoveArm
from rclpy.parameter import Parameter

from openarm_bringup.calibration.ros import dynamics as ros_dynamics
from openarm_bringup.calibration.ros.dynamics import DynamicsClient, pieces
from openarm_bringup.commands.calibrate_live import dynamics
from openarm_bringup.outcome import Outcome
from openarm_calibration.dynamics import excite
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import RecordStore, default_folder
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.servos import ArmLoad
from openarm_common.ros.convert import ns_to_stamp, trajectory_from_msg
from openarm_sim_bridge.world.hardware import HardwareConfig, drawn

pytestmark = pytest.mark.usefixtures("own_store")

NAMES = ("a", "b")


def identify(bench, **options) -> Outcome:
    """As typed next to the running graph."""
    with ThreadPoolExecutor(1) as worker:
        done = worker.submit(dynamics, domain=int(os.environ["ROS_DOMAIN_ID"]), **options)
        bench.ros.spin_until(done.done, 120.0, "the command to end")
        return done.result()


def taken_over(bench, done: Outcome) -> StoredServos:
    """The servos of the right arm that were identified and stored, once the bridge carries the arm by them."""
    assert done.success, done.message
    assert "joint  gain, N m/rad" in done.text
    stored = RecordStore(default_folder(), StoredServos).load("right")
    assert stored.dynamics_seed == 7
    servos, expected = bench.node._face._servos, f"identified {stored.digest()[:12]}"
    bench.ros.spin_until(lambda: servos.sources["right"] == expected, what="the bridge to use them")
    assert servos.sources["left"] == "as configured"
    return stored


class KnownArm(DynamicsClient):
    """An arm with known servos that goes exactly where it is sent, in place of the graph; no plan leads to one posture.

    Its servos are given the targets that they need for that.
    """

    STIFFNESS, DAMPING, FRICTION, LATENCY, PERIOD_S = np.linspace(60.0, 240.0, 7), 3.0, 0.4, 0.02, 0.01
    PARAMETERS: ClassVar = {"profile": "openarm", "openarm.dynamics_seed": 7, "controller": "/{arm}_controller/follow"}

    def _sources(self) -> set[str]:
        return {"mujoco_bridge"}

    def call(self, kind, name: str, request, timeout: float = 0.0):
        return kind.Response(
            values=[Parameter(n, value=self.PARAMETERS[n]).get_parameter_value() for n in request.names]
        )

    def do(self, kind, name: str, goal, **_):
        if kind is MoveArm:
            assert goal.arm == "right"
            self.at = list(goal.joint_positions)
            refused, self.refused = not getattr(self, "refused", False), True
            return MoveArm.Result(success=not refused, code="NO_PLAN" if refused else "OK")
        assert name == "/right_controller/follow"
        assert {one.position for one in [*goal.path_tolerance, *goal.goal_tolerance]} == {-1.0}
        (subscription,) = (
            one for one in self._node.subscriptions if one.topic_name == "/right_controller/controller_state"
        )
        names, t, q, _, _ = trajectory_from_msg(goal.trajectory)
        assert q[0] == pytest.approx(self.at)
        load = ArmLoad(self._description, names, self._description.tcp_link("right"))
        position = np.stack([np.interp(np.arange(0.0, t[-1], self.PERIOD_S), t, column) for column in q.T], axis=1)
        window = np.hanning(9) / np.hanning(9).sum()
        position = np.apply_along_axis(np.convolve, 0, np.pad(position, ((4, 4), (0, 0)), mode="edge"), window, "valid")
        velocity = np.gradient(position, self.PERIOD_S, axis=0)
        states = zip(position, velocity, np.gradient(velocity, self.PERIOD_S, axis=0), strict=True)
        torque = np.array([load.torque(*one) for one in states]) + self.DAMPING * velocity
        target = position + (torque + self.FRICTION * np.sign(velocity)) / self.STIFFNESS
        for k, late in enumerate(target[round(self.LATENCY / self.PERIOD_S) :]):
            message = JointTrajectoryControllerState(joint_names=names)
            message.header.stamp = ns_to_stamp(round(k * self.PERIOD_S * 1e9))
            message.feedback.positions, message.output.positions = position[k].tolist(), late.tolist()
            subscription.callback(message)
        return FollowJointTrajectory.Result(error_code=FollowJointTrajectory.Result.SUCCESSFUL)


@pytest.mark.long
def test_known_servos_are_identified_stored_and_used(bridge, monkeypatch) -> None:
    monkeypatch.setattr(excite, "_CYCLES", 4)
    monkeypatch.setattr(ros_dynamics, "DynamicsClient", KnownArm)
    bench = bridge(images=False, profile="openarm", openarm__dynamics_seed=7)
    done = dynamics(domain=int(os.environ["ROS_DOMAIN_ID"]), arm="right", postures=3)
    stored = taken_over(bench, done)
    np.testing.assert_allclose(stored.stiffness, KnownArm.STIFFNESS, rtol=0.15)
    np.testing.assert_allclose(stored.friction, KnownArm.FRICTION, atol=0.25)
    np.testing.assert_allclose(stored.damping, KnownArm.DAMPING, rtol=0.3)
    np.testing.assert_allclose(stored.latency, KnownArm.LATENCY, atol=0.008)


@pytest.mark.long
def test_servos_are_identified_stored_and_used(ros, bridge) -> None:
    bench = bridge(images=False, profile="openarm", openarm__dynamics_seed=7, speed=1.0)
    said = bench.collect(DiagnosticArray, "/diagnostics", 10)
    # signs of life are not exchanged within a process
    motion = subprocess.Popen([sys.executable, "-m", "openarm_motion.ros.node"])
    try:
        able = {("motion: status", DiagnosticStatus.OK)}  # it has joint states; `openarm up` waits for that, too
        ros.spin_until(lambda: able & {(s.name, s.level) for m in said for s in m.status}, what="the motion node")
        done = identify(bench, arm="right", postures=2)
    finally:
        motion.terminate()
        motion.wait()
    stored = taken_over(bench, done)
    made, names = drawn(HardwareConfig(dynamics_seed=7), bench.node.description), bench.ARM
    np.testing.assert_allclose(stored.stiffness, [made.stiffness[name] for name in names], rtol=0.15)
    np.testing.assert_allclose(stored.friction, [made.friction[name] for name in names], atol=0.25)


def test_ideal_servos_are_not_identified(bench) -> None:
    bench.ros.spin_until(lambda: bench.joints, what="joint states")
    with pytest.raises(OpenArmError, match="the servos of the profile `ideal` are known") as caught:
        identify(bench, arm="right")
    assert caught.value.code is Code.INVALID_ARGUMENT


@pytest.mark.parametrize("wrong", [{"arm": "middle"}, {"postures": 1}])
def test_choices_are_listed(wrong: dict[str, object]) -> None:
    with pytest.raises(OpenArmError, match=r"expected (left, right or both|2 to 100)"):
        dynamics(domain=int(os.environ.get("ROS_DOMAIN_ID", "0")), **wrong)


def state(t_ms: int, output: bool = True) -> JointTrajectoryControllerState:
    message = JointTrajectoryControllerState(joint_names=["b", "a"])
    message.header.stamp = ns_to_stamp(t_ms * 1_000_000)
    message.feedback.positions = [2.0, 1.0]
    message.output.positions = [4.0, 3.0] if output else []
    return message


def test_logs_end_at_gaps_and_have_the_joints_in_order() -> None:
    first, second = pieces(NAMES, [state(t) for t in (0, 10, 20, 50, 60, 70, 80)])
    assert (len(first.target), len(second.target)) == (3, 4)
    assert first.period_s == 0.01
    np.testing.assert_array_equal(first.position[0], [1.0, 2.0])
    np.testing.assert_array_equal(first.target[0], [3.0, 4.0])


def test_a_controller_that_does_not_say_what_it_commands_is_refused() -> None:
    with pytest.raises(OpenArmError, match="0 of 5 messages on controller_state have the output of all joints"):
        pieces(NAMES, [state(t, output=False) for t in range(0, 50, 10)])
