# SPDX-License-Identifier: Apache-2.0
"""Each fault of robot and world that can be injected, seen on the wire; and that it ends when it is cleared."""

from __future__ import annotations

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseStamped
from openarm_interfaces.msg import ObjectStateArray
from openarm_interfaces.srv import ClearFaults, InjectFault, MoveObject, RemoveObject

from openarm_common.ros.node import QOS_COMMAND
from openarm_sim_bridge.faults.faults import FAULTS

FINGER = "openarm_right_finger_joint1"
ELBOW = "openarm_right_joint4"


# --- robot and world


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
    assert not bench.grip(0.03).result.reached_goal
    assert bench.position(FINGER) < 0.005
    bench.clear()
    bench.ros.spin_until(lambda: abs(bench.position(FINGER) - 0.03) < 0.002, what="the gripper to be free")


def test_gripper_weak_and_that_it_is_reported(bench) -> None:
    got = bench.collect(DiagnosticArray, "/diagnostics", QOS_COMMAND)

    def reported() -> list[str]:
        return [v.value for m in got[-1:] for s in m.status for v in s.values if v.key == "faults_active"]

    bench.inject("gripper_weak", "{share: 0.05}")
    bench.ros.spin_until(lambda: reported() == ["gripper_weak"], what="the fault on /diagnostics")
    bench.joints.clear()
    assert bench.grip(0.04).result.reached_goal
    column = bench.joints[0].name.index(FINGER)
    assert max(abs(m.effort[column]) for m in bench.joints) <= 1.51
    bench.clear()
    bench.ros.spin_until(lambda: reported() == [""], what="its end on /diagnostics")


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


# --- objects
@pytest.mark.requirement("P-25")
def test_objects_are_moved_and_removed(bench) -> None:
    got = bench.collect(ObjectStateArray, "/sim/ground_truth/objects", 5)

    def objects() -> dict:
        return {o.name: o.pose.position for o in bench.fresh(got, 3)[-1].objects}

    names = set(objects())
    pose = PoseStamped()
    pose.pose.position.x, pose.pose.position.y = 0.45, 0.0
    bench.done(MoveObject, "/sim/move_object", name="red_cube", pose=pose)
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
    bench.done(RemoveObject, "/sim/remove_object", name="red_cube")
    assert set(objects()) == names - {"red_cube"}
    answer = bench.call(RemoveObject, "/sim/remove_object", name="red_cube")
    assert not answer.success
    assert other in answer.message
    stands = objects()[other]
    assert (stands.x, stands.y) == pytest.approx((there.x, there.y), abs=1e-3)
