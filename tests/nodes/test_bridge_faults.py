# SPDX-License-Identifier: Apache-2.0
"""Each fault of robot and world that can be injected, seen on the wire; and that it ends when it is cleared."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import ClearFaults, InjectFault, MoveObject, RemoveObject
from sensor_msgs.msg import JointState

from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import QOS_COMMAND, reliable
from openarm_sim_bridge.faults.faults import FAULTS

FINGER = "openarm_right_finger_joint1"
ELBOW = "openarm_right_joint4"


def stamps(messages: list) -> np.ndarray:
    return np.array([stamp_to_ns(m.header.stamp) for m in messages])


# --- robot and world
def test_joint_state_gap(bridge) -> None:
    bench = bridge(images=False, speed=1.0)  # publishes each tick
    states = bench.collect(JointState, "/joint_states", reliable(2000))  # a starved probe misses none

    def gaps_ms(seconds: float) -> np.ndarray:
        """Times between the joint states of so many seconds, from 0.3 s after now on."""
        begin = bench.t_ns + 300_000_000
        end = begin + round(seconds * 1e9)
        bench.ros.spin_until(lambda: states and stamps(states[-1:])[0] >= end, what=f"{seconds} s of joint states")
        heard = stamps(states)
        return np.diff(heard[heard >= begin]) * 1e-6

    bench.inject("joint_state_gap", "{ms: 150, every: 0.25}", seed=3)
    assert 3 <= np.sum(gaps_ms(1.0) >= 140) <= 5
    bench.clear()
    assert gaps_ms(0.5).max() < 100


def test_object_nudged(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)

    def cube() -> np.ndarray:
        item = next(o for o in bench.fresh(got, 3)[-1].objects if o.name == "red_cube")
        p = item.pose.position
        return np.array([p.x, p.y, p.z])

    before = cube()
    bench.inject("object_nudged", "{object: red_cube, mm: 15}", seed=2)
    shift = cube() - before
    assert np.hypot(*shift[:2]) == pytest.approx(0.015, abs=0.001)
    assert abs(shift[2]) < 0.001
    answer = bench.call(InjectFault, "/sim/inject_fault", name="object_nudged", parameters="{object: pear}", seed=0)
    assert not answer.success
    assert "red_cube" in answer.message


def test_friction_lowered(bench) -> None:
    """In the model; that a held object slips out is seen in test_bridge_grippers, where one is held."""
    model = bench.node._simulation.world.model
    before = model.geom_friction.copy()
    bench.inject("friction_lowered", "{scale: 0.1}")
    bench.spin_sim(0.1)
    np.testing.assert_allclose(model.geom_friction, 0.1 * before)
    bench.clear()
    bench.spin_sim(0.1)
    np.testing.assert_allclose(model.geom_friction, before)


def test_gripper_stuck(bench) -> None:
    bench.inject("gripper_stuck", "{side: right}")
    result = bench.grip(0.03).result
    assert not result.reached_goal
    assert bench.position(FINGER) < 0.005
    bench.clear()
    bench.ros.spin_until(lambda: abs(bench.position(FINGER) - 0.03) < 0.002, what="the gripper to be free")


def test_gripper_weak(bench) -> None:
    bench.inject("gripper_weak", "{share: 0.05}")
    bench.joints.clear()
    assert bench.grip(0.04).result.reached_goal
    column = bench.joints[0].name.index(FINGER)
    assert max(abs(m.effort[column]) for m in bench.joints) <= 1.51


def test_joint_sag(bench) -> None:
    before = bench.position(ELBOW)
    bench.inject("joint_sag", "{side: right, share: 0.0}")
    bench.spin_sim(1.0)
    right = {name: p for name, p in zip(bench.joints[-1].name, bench.joints[-1].position, strict=True)}
    assert abs(bench.position(ELBOW) - before) > 0.002
    assert abs(right["openarm_left_joint4"] - 1.2) < 0.001
    bench.clear()
    bench.spin_sim(1.0)
    assert bench.position(ELBOW) == pytest.approx(before, abs=0.001)


def test_joint_late(bench) -> None:
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count())

    def moves_after(target: float) -> float:
        start, at = bench.t_ns, bench.position(ELBOW)
        publisher.publish(JointState(name=[ELBOW], position=[target]))
        bench.ros.spin_until(lambda: abs(bench.position(ELBOW) - at) > 0.01, what="the elbow to move")
        return (bench.t_ns - start) * 1e-9

    moves_after(1.3)
    bench.spin_sim(0.5)
    bench.inject("joint_late", "{ms: 600}")
    assert moves_after(1.2) > 0.6


# --- asking
def test_a_wrong_fault_is_answered_with_what_there_is(bench) -> None:
    for fields, parts in (
        ({"name": "gremlin"}, ["gremlin", *FAULTS]),
        ({"name": "camera_drop", "parameters": "{share: 2.0}"}, ["share", "2.0"]),
        ({"name": "camera_drop", "parameters": "{shade: 0.2}"}, ["shade", "share"]),
        ({"name": "camera_drop", "parameters": "[1"}, ["YAML"]),
        ({"name": "camera_drop", "parameters": "7"}, ["mapping"]),
        ({"name": "camera_drop", "seed": -1}, ["seed"]),
        ({"name": "gripper_weak", "parameters": "{side: middle}"}, ["left", "right", "both"]),
        ({"name": "camera_drop"}, ["no cameras"]),
    ):
        answer = bench.call(InjectFault, "/sim/inject_fault", **fields)
        assert not answer.success
        for part in parts:
            assert part in answer.message
    assert not bench.call(ClearFaults, "/sim/clear_faults", name="gremlin").success


def test_active_faults_are_reported_on_diagnostics(bench) -> None:
    got = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)
    bench.inject("gripper_weak")

    def reported() -> str:
        values = [v for m in got[-1:] for s in m.status for v in s.values if v.key == "faults_active"]
        return values[0].value if values else ""

    bench.ros.spin_until(lambda: reported() == "gripper_weak", what="the fault on /diagnostics")
    bench.clear()
    bench.ros.spin_until(lambda: reported() == "")


# --- objects
@pytest.mark.requirement("P-25")
def test_objects_are_moved_and_removed(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)

    def objects() -> dict:
        return {o.name: o.pose.position for o in bench.fresh(got, 3)[-1].objects}

    names = set(objects())
    pose = PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.45, 0.0
    answer = bench.call(MoveObject, "/sim/move_object", name="red_cube", pose=pose)
    assert answer.success, answer.message
    p = objects()["red_cube"]
    np.testing.assert_allclose([p.x, p.y, p.z], [0.45, 0.0, 0.425], atol=0.001)
    other = next(name for name in names if name != "red_cube")
    there = objects()[other]
    pose.pose.position.x, pose.pose.position.y = there.x, there.y
    answer = bench.call(MoveObject, "/sim/move_object", name="red_cube", pose=pose)
    assert not answer.success
    assert other in answer.message
    p = objects()["red_cube"]
    np.testing.assert_allclose([p.x, p.y, p.z], [0.45, 0.0, 0.425], atol=0.001)
    assert bench.call(RemoveObject, "/sim/remove_object", name="red_cube").success
    assert set(objects()) == names - {"red_cube"}
    answer = bench.call(RemoveObject, "/sim/remove_object", name="red_cube")
    assert not answer.success
    assert other in answer.message
    stands = objects()[other]
    assert (stands.x, stands.y) == pytest.approx((there.x, there.y), abs=1e-3)
