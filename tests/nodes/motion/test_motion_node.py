# SPDX-License-Identifier: Apache-2.0
"""The motion node against a fake robot (see conftest.py): kinematics, moves, approaches."""

from __future__ import annotations

import threading
import time
from functools import partial

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, Vector3
from openarm_interfaces.action import ExecuteTrajectory, MoveArm, MoveArms, PlanApproach
from openarm_interfaces.msg import ApproachTarget, ArmTarget, CollisionBox
from openarm_interfaces.srv import ComputeIK
from rclpy.parameter import Parameter
from unique_identifier_msgs.msg import UUID

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import matrix_to_pose
from openarm_common.ros.holds import Holder
from openarm_common.scene.scene import load_scene
from openarm_motion.planning.planner import PlannedPath, PlanQuery
from openarm_motion.service.motion_service import table_box
from tests.conftest import DEADLINE_S


# --- inverse kinematics
@pytest.mark.requirement("A-66")
def test_compute_ik_in_the_table_frame_or_what_is_wrong(bench) -> None:
    target = se3.make(bench.DOWN, (0.4, 0.2, 0.3))
    request = ComputeIK.Request(arm="left", pose=bench.stamped(target, "table"), position_only=True)
    answer = bench.ros.call(bench.ik_client, request)
    assert (answer.success, answer.code) == (True, "OK")
    assert answer.position_error < 1e-4
    reached = bench.description.link_pose(
        "openarm_left_hand_tcp", dict(zip(bench.description.arm_joints("left"), answer.joint_positions, strict=True))
    )
    np.testing.assert_allclose(reached[:3, 3], [0.4, 0.2, 0.7], atol=1e-4)
    request.position_only = False
    answer = bench.ros.call(bench.ik_client, request)
    assert (answer.success, answer.code) == (False, "UNREACHABLE")
    assert "left arm can't reach (0.400, 0.200, 0.700) m" in answer.message
    assert 0.0 < answer.position_error < 0.1
    assert abs(answer.nearest.position.x - 0.4) < 0.1
    nearest = ", ".join(f"{getattr(answer.nearest.position, axis):.3f}" for axis in "xyz")
    assert f"{answer.position_error * 1e3:.0f} mm" in answer.message
    assert f"away, at ({nearest}) m" in answer.message
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="third", pose=bench.stamped(np.eye(4))))
    assert (answer.code, answer.message) == ("INVALID_ARGUMENT", "arm is 'third'; arms: left, right")
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=bench.stamped(np.eye(4), "nowhere")))
    assert answer.code == "NO_TRANSFORM"
    assert "table" in answer.message
    bad = PoseStamped()
    bad.pose.orientation.w = 0.0
    answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=bad))
    assert answer.code == "INVALID_ARGUMENT"


# --- moves


def test_refused_moves_say_why(bench) -> None:
    kinds, home = MoveArm.Goal, partial(MoveArm.Goal, arm="right", kind=MoveArm.Goal.NAMED, named="home")
    flat = CollisionBox(id="flat", size=Vector3(x=0.1, y=0.1, z=0.0))
    in_table = bench.stamped(se3.make(bench.DOWN, (0.25, -0.25, 0.38)))
    too_far = bench.stamped(se3.make(bench.DOWN, (0.4, 0.2, 0.3)), "table")
    cases = [
        (MoveArm.Goal(arm="left", kind=9), "INVALID_ARGUMENT", "kind is 9"),
        (bench.named(posture="yoga"), "INVALID_ARGUMENT", "no state 'yoga'"),
        (MoveArm.Goal(arm="right", kind=kinds.JOINTS, joint_positions=[0.0] * 6), "INVALID_ARGUMENT", "goal has 6"),
        (MoveArm.Goal(arm="right", kind=kinds.POSE, pose=in_table), "IN_COLLISION", "table"),
        (MoveArm.Goal(arm="left", kind=kinds.POSE, pose=too_far), "UNREACHABLE", "nearest reachable pose"),
        (home(velocity_scale=1.5), "INVALID_ARGUMENT", "velocity_scale is 1.5"),
        (home(velocity_scale=1e-9), "INVALID_ARGUMENT", "velocity_scale is 1e-09, expected 0.001 to 1"),
        (bench.named(obstacles=[flat]), "INVALID_ARGUMENT", "box 'flat' has size"),
    ]
    for goal, code, text in cases:
        bench.refused(bench.move_client, goal, code, text)


# --- approaches
def approach_goal(bench, **kwargs) -> PlanApproach.Goal:
    target = ApproachTarget(id="top", pose=matrix_to_pose(se3.make(bench.DOWN, (0.26, -0.24, 0.425))), score=1.0)
    target.approach_offset.z, target.retreat_offset.z = 0.08, 0.12
    far = ApproachTarget(id="far", pose=matrix_to_pose(se3.make(bench.DOWN, (0.7, -0.24, 0.425))), score=2.0)
    cube = CollisionBox(id="cube", pose=matrix_to_pose(se3.make(None, (0.26, -0.24, 0.425))))
    cube.size.x = cube.size.y = cube.size.z = 0.05
    return PlanApproach.Goal(
        arm="right", targets=[far, target], obstacles=[cube], touchable=["cube"], velocity_scale=1.0, **kwargs
    )


@pytest.mark.parametrize("blend", [False, True])
def test_a_grasp_is_planned_executed_and_shown_as_attached_b47(bench, blend: bool) -> None:
    plan = bench.run(bench.plan_client, approach_goal(bench, attached_after_approach=True, blend_approach=blend))
    assert (plan.success, plan.code, plan.chosen) == (True, "OK", 1), plan.message
    assert [(r.id, r.code) for r in plan.refusals] == [("far", "UNREACHABLE")]
    far, near = plan.limit_margins
    assert np.isnan(far)
    assert 0.05 <= near < 1.6  # the limit margin of the planner, and less than half of the narrowest joint's range
    assert plan.planning_time > 0.0
    last, first = plan.transfer.points[-1].positions, plan.approach.points[0].positions
    np.testing.assert_allclose(first, last, atol=1e-6)
    assert (list(plan.approach.points[-1].positions) == list(first)) is blend
    for part, held in ((plan.transfer, []), (plan.approach, []), (plan.retreat, ["right/cube"])):
        bench.done(bench.execute_client, ExecuteTrajectory.Goal(arm="right", trajectory=part))
        bench.ros.spin_until(lambda held=held: bench.held() == held, what=f"{held} shown as attached")
    near = {bench.node.config.execution.goal_tolerance}
    assert bench.robot.tolerances == [set() if blend else near, set(), near], "none of its own where it touches"
    marker = bench.markers[-1].markers[-1]
    assert marker.header.frame_id == "openarm_right_hand_tcp"
    assert marker.scale.x == pytest.approx(0.05)
    arm = bench.node.service.arms["right"]
    np.testing.assert_allclose(arm.kinematics.fk(bench.q("right"))[:3, 3], [0.26, -0.24, 0.545], atol=1e-3)


def test_an_approach_that_fails_carries_all_refusals(bench) -> None:
    goal = approach_goal(bench)
    goal.targets = goal.targets[:1]
    plan = bench.run(bench.plan_client, goal)
    assert (plan.success, plan.code, plan.chosen) == (False, "UNREACHABLE", -1)
    assert plan.message.startswith("right arm: far: ")
    assert [(r.id, r.code) for r in plan.refusals] == [("far", "UNREACHABLE")]
    goal = approach_goal(bench)
    goal.touchable = ["cup"]
    assert bench.run(bench.plan_client, goal).code == "INVALID_ARGUMENT"
    goal = approach_goal(bench)
    goal.targets, goal.touchable, goal.obstacles[0].size.y = goal.targets[1:], [], 0.2
    (refusal,) = bench.run(bench.plan_client, goal).refusals
    assert (refusal.code, refusal.first.startswith("openarm_right_"), refusal.second) == ("IN_COLLISION", True, "cube")


@pytest.mark.requirement("N-03")
def test_plans_fail_by_injection_while_the_node_runs(bench) -> None:
    """All of them, or no more than so many; a share that cannot be is refused."""

    def set_faults(**values: float) -> bool:
        answers = bench.node.set_parameters([Parameter(f"faults.{k}", value=v) for k, v in values.items()])
        return all(answer.successful for answer in answers)

    def codes(count: int) -> list[str]:
        return [bench.run(bench.plan_client, approach_goal(bench)).code for _ in range(count)]

    assert codes(1) == ["OK"]
    assert set_faults(no_plan_share=1.0)
    assert codes(2) == ["NO_PLAN", "NO_PLAN"]
    assert not set_faults(no_plan_share=1.5)
    assert set_faults(no_plan_limit=1)
    assert codes(3) == ["NO_PLAN", "OK", "OK"]
    assert set_faults(no_plan_share=0.0)
    assert codes(1) == ["OK"]


@pytest.mark.requirement("B-49")
def test_table_comes_from_the_scene_description() -> None:
    table = table_box(load_scene("empty").table)
    np.testing.assert_allclose(table.T[:3, 3], [0.46, 0.0, 0.38])
    np.testing.assert_allclose(table.size, [0.70, 1.20, 0.04])


class WaitingPlanner:
    """Searches until it is stopped."""

    def __init__(self) -> None:
        self.searching, self.ended = threading.Event(), threading.Event()

    def plan(self, query: PlanQuery) -> PlannedPath:
        self.searching.set()
        deadline = time.monotonic() + DEADLINE_S
        while not query.stopped():
            assert time.monotonic() < deadline, "the search was not stopped"
            threading.Event().wait(0.01)
        self.ended.set()
        raise OpenArmError(Code.CANCELLED, "planning was stopped")


def test_a_search_ends_by_cancel_and_with_the_node(bench) -> None:
    arm, planner = bench.node.service.arms["right"], WaitingPlanner()
    arm._planner, arm.direct = planner, False  # it is asked for every path
    for client, goal in ((bench.move_client, bench.named()), (bench.plan_client, approach_goal(bench))):
        planner.searching.clear()
        handle, future = bench.start(client, goal)
        bench.ros.spin_until(planner.searching.is_set, what="the search")
        # others are answered meanwhile
        answer = bench.ros.call(bench.ik_client, ComputeIK.Request(arm="left", pose=bench.stamped(np.eye(4))))
        assert answer.code == "UNREACHABLE"
        assert not future.done()
        bench.ros.result(handle.cancel_goal_async())
        answer = bench.ros.result(future)
        assert answer.status == 5  # canceled
        assert answer.result.code == "CANCELLED"
    planner.searching.clear()
    planner.ended.clear()
    bench.start(bench.move_client, bench.named())
    bench.ros.spin_until(planner.searching.is_set, what="the search")
    bench.node.close()
    assert planner.ended.is_set()


@pytest.mark.requirement("P-21")
def test_an_arm_that_a_client_holds_moves_for_that_client_alone_and_its_controller_sees_whose_goal_it_is(bench) -> None:
    # the controller may have heard an announcement that the motion node has not: topics keep no common order
    mine = UUID(uuid=list(range(16)))
    assert bench.run(bench.move_client, bench.named("right", "home"), goal_uuid=mine).success
    assert bench.robot.goal_ids[-1][:8] == bytes(range(8))

    holder = Holder(bench.node)
    holder.name = "the grasp node (a grasp of 'red')"
    holder.hold("right")
    key = bytes(holder.goal_id().uuid[:8])
    bench.ros.spin_until(lambda: bytes(bench.node._holds.goal_id("right").uuid[:8]) == key, what="the hold")
    both = MoveArms.Goal(targets=[ArmTarget(arm=arm, kind=ArmTarget.NAMED, named="home") for arm in ("left", "right")])
    for client, goal in ((bench.move_client, bench.named("right")), (bench.both_client, both)):
        message = bench.refused(client, goal, "BUSY")
        assert message.startswith("the right arm is held by the grasp node (a grasp of 'red')")
    assert bench.run(bench.move_client, bench.named("right", plan_only=True)).success
    assert bench.run(bench.move_client, bench.named("left", "home")).success
    assert bench.run(bench.move_client, bench.named("right", "home"), goal_uuid=holder.goal_id()).success
    assert bench.robot.goal_ids[-1][:8] == key
    holder.release()
