# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: the grippers."""

from __future__ import annotations

import math

import pytest
from action_msgs.msg import GoalStatus
from geometry_msgs.msg import PoseStamped, Vector3, WrenchStamped
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import InjectFault, SetPause, SpawnObject
from sensor_msgs.msg import JointState

from openarm_common.ros.convert import point
from openarm_common.ros.node import QOS_SENSOR


@pytest.mark.requirement("P-22", "B-55")
def test_the_gripper_reaches_its_goal(bench) -> None:
    position = 0.035
    answer = bench.grip(position)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert answer.result.reached_goal
    assert not answer.result.stalled
    assert answer.result.state.position[0] == pytest.approx(position, abs=0.001)
    bench.ros.spin_until(lambda: abs(bench.position(bench.FINGER) - position) < 0.001, what="a joint state of it")


@pytest.mark.requirement("P-22")
def test_a_gripper_stalls_on_an_object_and_says_so(bench) -> None:
    """A box is put between fingers that are nearly closed, in a world that stands still."""
    level = bench.posture(lambda T: [10.0 * T[2, 1], *(T[:3, 3] - [0.40, -0.39, 0.75])])  # opening axis horizontal
    bench.ros.result(bench.follow(bench.goal((1.5, level)))[1])
    assert bench.grip(0.016).result.reached_goal
    assert bench.call(SetPause, "/sim/set_pause", paused=True).success
    T = bench.tcp_pose()
    pose = PoseStamped()
    pose.header.frame_id = "world"
    pose.pose.position = point(T[:3, 3] - 0.017 * T[:3, 2])
    yaw = math.atan2(-T[0, 1], T[1, 1])  # the box's y along the opening axis
    pose.pose.orientation.z, pose.pose.orientation.w = math.sin(yaw / 2), math.cos(yaw / 2)
    size = Vector3(x=0.02, y=0.030, z=0.02)
    bench.done(
        SpawnObject, "/sim/spawn_object", name="held", shape="box", size=size, color="purple", mass=0.02, pose=pose
    )
    handle, future = bench.send_grip(JointState(name=[bench.FINGER], position=[0.0]))
    assert handle.accepted
    assert bench.call(SetPause, "/sim/set_pause", paused=False).success
    answer = bench.ros.result(future)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED
    assert (answer.result.stalled, answer.result.reached_goal) == (True, False)
    assert 2 * answer.result.state.position[0] == pytest.approx(0.030, abs=0.001)
    assert answer.result.state.effort[0] == pytest.approx(-30.0, abs=1.0)
    pads = [
        bench.collect(WrenchStamped, f"/openarm_right_{finger}_finger/contact_wrench", QOS_SENSOR)
        for finger in ("left", "right")
    ]
    wrists = bench.collect(WrenchStamped, "/right_force_torque_sensor_broadcaster/wrench", QOS_SENSOR)
    bench.ros.spin_until(lambda: all(pads) and wrists, what="force sensors")
    for got in pads:  # each presses with half of the force
        force = got[-1].wrench.force
        assert math.hypot(force.x, force.y, force.z) == pytest.approx(15.0, abs=1.5)
    assert pads[0][-1].wrench.force.y * pads[1][-1].wrench.force.y < 0.0
    assert pads[0][-1].header.frame_id == "openarm_right_left_finger"
    assert wrists[-1].header.frame_id == "openarm_right_hand"
    bench.spin_sim(1.0)
    held = next(o for o in bench.node._simulation.world.objects() if o.object.name == "held")
    assert held.T_world_object[2, 3] > 0.6  # by friction alone
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)
    assert bench.call(InjectFault, "/sim/inject_fault", name="friction_lowered", parameters="{scale: 0.0}").success
    bench.ros.spin_until(
        lambda: got and any(o.name == "held" and o.pose.position.z < 0.6 for o in got[-1].objects), what="its fall"
    )


def test_bad_gripper_goals_are_rejected(bench) -> None:
    for command in (
        JointState(name=[bench.FINGER], position=[0.2]),
        JointState(name=["thumb"], position=[0.0]),
        JointState(name=[bench.FINGER]),
        JointState(name=[bench.FINGER], position=[float("nan")]),
    ):
        handle, _ = bench.send_grip(command)
        assert not handle.accepted
