# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: the emergency stop."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from openarm_bringup.commands.stop import stop
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND

#: A joint is never further from where it comes to rest, rad: the simulated arm rings by 11 mrad from 0.7 rad/s.
_RINGING = 0.020


def _states(bench, since_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """Positions (n, 7), rad, and velocities (n, 7), rad/s, of the arm after a stamp."""
    states = [m for m in bench.joints if stamp_to_ns(m.header.stamp) > since_ns]
    columns = [states[0].name.index(name) for name in bench.ARM]
    return np.array([m.position for m in states])[:, columns], np.array([m.velocity for m in states])[:, columns]


def test_the_arm_holds_at_once_the_hand_stays_and_nothing_moves_until_the_reset(bench) -> None:
    assert bench.grip(0.0).result.reached_goal
    client = bench.ros.node.create_client(Trigger, "/stop")
    bench.ros.spin_until(client.service_is_ready, what="the service")
    far = [q + 1.8 for q in bench.NEAR_HOME[:1]] + list(bench.NEAR_HOME[1:])
    _, future = bench.follow(bench.goal((4.0, far)))
    bench.ros.spin_until(lambda: np.abs(_states(bench, bench.t_ns - 50_000_000)[1]).max() > 0.5, what="it moves")
    asked = client.call_async(Trigger.Request())
    bench.ros.spin_until(asked.done, what="the answer")
    answered_ns = bench.node._simulation.robot.state.t_ns
    assert asked.result().success
    bench.spin_sim(0.5)
    positions, velocities = _states(bench, answered_ns)
    assert np.abs(positions - positions[-1]).max() < _RINGING
    assert np.abs(velocities[-1]).max() < 0.05

    answer = bench.ros.result(future)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == -100
    assert "emergency stop is latched" in answer.result.error_string

    held, finger = bench.arm.copy(), bench.position(bench.FINGER)
    _, refused = bench.follow(bench.goal((1.0, bench.NEAR_HOME)))
    result = bench.ros.result(refused).result
    assert (result.error_code, result.error_string.startswith("STOPPED")) == (-100, True)
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(publisher.get_subscription_count, what="the bridge")
    publisher.publish(JointState(name=list(bench.ARM), position=list(bench.NEAR_HOME)))
    assert not bench.send_grip(JointState(name=[bench.FINGER], position=[0.03]))[0].accepted
    bench.spin_sim(0.4)
    np.testing.assert_allclose(bench.arm, held, atol=0.005)
    assert abs(bench.position(bench.FINGER) - finger) < 0.0005

    with ThreadPoolExecutor(1) as pool:
        reset = pool.submit(stop, reset=True)
        bench.ros.spin_until(reset.done, what="the command")
    assert reset.result().success, reset.result().message
    _, future = bench.follow(bench.goal((3.0, bench.NEAR_HOME)))
    assert bench.ros.result(future).result.error_code == FollowJointTrajectory.Result.SUCCESSFUL
    np.testing.assert_allclose(bench.arm, bench.NEAR_HOME, atol=0.02)
