# SPDX-License-Identifier: Apache-2.0
"""MoveIt's actions, services and topics, before the motion node with a fake robot."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import (
    AttachedCollisionObject,
    CollisionObject,
    DisplayTrajectory,
    JointConstraint,
    PlanningScene,
)
from moveit_msgs.msg import MoveItErrorCodes as Codes
from moveit_msgs.srv import (
    GetCartesianPath,
    GetPositionFK,
    GetPositionIK,
    GetStateValidity,
    QueryPlannerInterfaces,
)
from rclpy.action.client import ClientGoalHandle
from std_msgs.msg import String
from visualization_msgs.msg import MarkerArray

from openarm_common import se3
from openarm_common.ros.convert import matrix_to_pose, pose_to_matrix
from openarm_common.ros.node import QOS_LATCHED
from tests.nodes.motion.conftest import SLOWER
from tests.nodes.motion.moveit_client import GROUP, SIDE, Client

pytestmark = pytest.mark.requirement("R-28", "A-76", "B-41")


@pytest.fixture
def client(moveit_bench) -> Client:
    return Client(moveit_bench)


def test_a_joint_goal_is_planned_shown_and_executed(client: Client) -> None:
    shown = client.ros.hear(DisplayTrajectory, "/display_planned_path", QOS_LATCHED)
    goal = client.named()

    answer = client.plan(client.joint_goal(goal))

    assert answer.error_code.val == Codes.SUCCESS, answer.error_code.message
    assert client.end(answer.trajectory) == pytest.approx(goal, abs=1e-3)
    client.ros.spin_until(lambda: shown, what="the plan on /display_planned_path")
    assert shown[0].trajectory[0] == answer.trajectory
    result = client.bench.run(client.execute, ExecuteTrajectory.Goal(trajectory=answer.trajectory))
    assert result.error_code.val == Codes.SUCCESS, result.error_code.message
    assert client.q() == pytest.approx(goal, abs=2e-3)


@pytest.mark.long
@pytest.mark.requirement("B-40")
def test_move_action_plans_and_moves_to_a_pose_within_its_tolerance_unless_it_is_to_plan_only(client: Client) -> None:
    before = client.q()
    goal = MoveGroup.Goal(request=client.joint_goal(client.named()))
    goal.planning_options.plan_only = True
    assert client.bench.run(client.move, goal).error_code.val == Codes.SUCCESS
    assert client.q() == pytest.approx(before, abs=1e-6)

    T = client.arm.kinematics.fk(client.named())
    T[:3, 3] += (0.02, 0.03, 0.04)

    result = client.bench.run(client.move, MoveGroup.Goal(request=client.pose_goal(T)))

    assert result.error_code.val == Codes.SUCCESS, result.error_code.message
    there = client.arm.kinematics.fk(client.q())
    assert np.linalg.norm(there[:3, 3] - T[:3, 3]) < 2e-3
    assert len(result.planned_trajectory.joint_trajectory.points) > 2


@pytest.mark.long
def test_a_goal_that_is_cancelled_or_stopped_by_the_event_ends_with_the_arm_holding(client: Client) -> None:
    goal = MoveGroup.Goal(request=client.joint_goal(client.named()))
    goal.request.max_velocity_scaling_factor = goal.request.max_acceleration_scaling_factor = 0.1
    client.bench.robot.speed = SLOWER
    publisher = client.node.create_publisher(String, "/trajectory_execution_event", 1)
    client.ros.spin_until(publisher.get_subscription_count, what="a listener")
    stop = lambda _: publisher.publish(String(data="stop"))  # noqa: E731
    for end in (ClientGoalHandle.cancel_goal_async, stop):
        handle, future = client.bench.start(client.move, goal)
        client.bench.under_way(SIDE)
        end(handle)
        assert client.ros.result(future).result.error_code.val == Codes.PREEMPTED
        assert SIDE not in client.bench.robot.active


def test_a_path_constraint_holds_at_every_point_from_the_start_state_and_a_start_that_violates_it_is_named_so(
    client: Client,
) -> None:
    start = client.arm.kinematics.fk(client.named())
    there = start.copy()
    there[:3, 3] += (0.03, 0.08, 0.05)
    request = client.pose_goal(there)
    request.start_state.joint_state.name = list(client.arm.names)
    request.start_state.joint_state.position = client.named().tolist()
    upright = client.pose_constraints(start).orientation_constraints[0]
    upright.absolute_x_axis_tolerance = upright.absolute_y_axis_tolerance = 0.05
    upright.absolute_z_axis_tolerance = 3.2
    request.path_constraints.orientation_constraints = [upright]

    answer = client.plan(request)

    assert answer.error_code.val == Codes.SUCCESS, answer.error_code.message
    points = answer.trajectory.joint_trajectory.points
    for q in (np.array(point.positions) for point in points):
        R = client.arm.kinematics.fk(q)[:3, :3]
        tilt = np.arccos(np.clip((start[:3, :3].T @ R)[2, 2], -1.0, 1.0))
        assert tilt < 0.08
    assert points[0].positions == pytest.approx(client.named(), abs=1e-6), "the start state"

    request = client.joint_goal(client.named("hands_up"))
    first = client.arm.names[0]
    request.path_constraints.joint_constraints = [
        JointConstraint(joint_name=first, position=float(client.q()[0]) + 0.5, tolerance_above=0.1, tolerance_below=0.1)
    ]
    answer = client.plan(request)
    assert answer.error_code.val == Codes.START_STATE_VIOLATES_PATH_CONSTRAINTS
    assert first in answer.error_code.message


def test_a_straight_line_is_followed_as_far_as_it_goes(client: Client) -> None:
    client.bench.run(client.move, MoveGroup.Goal(request=client.joint_goal(client.named())))
    T = client.arm.kinematics.fk(client.q())
    near, far = T.copy(), T.copy()
    near[2, 3] += 0.05
    far[2, 3] += 3.0
    request = GetCartesianPath.Request(group_name=GROUP, max_step=0.01, avoid_collisions=True)

    request.waypoints = [matrix_to_pose(near)]
    whole = client.call(GetCartesianPath, "/compute_cartesian_path", request)
    request.waypoints = [matrix_to_pose(far)]
    part = client.call(GetCartesianPath, "/compute_cartesian_path", request)

    assert (whole.error_code.val, whole.fraction) == (Codes.SUCCESS, 1.0)
    assert client.arm.kinematics.fk(client.end(whole.solution)) == pytest.approx(near, abs=1e-3)
    assert 0.0 <= part.fraction < 0.5
    assert part.error_code.message


def test_ik_and_fk_are_each_others_inverse(client: Client) -> None:
    T = client.arm.kinematics.fk(client.named())
    request = GetPositionIK.Request()
    request.ik_request.group_name, request.ik_request.avoid_collisions = GROUP, True
    request.ik_request.pose_stamped.pose = matrix_to_pose(T)

    solved = client.call(GetPositionIK, "/compute_ik", request)
    fk = GetPositionFK.Request(fk_link_names=[client.tool], robot_state=solved.solution)
    found = client.call(GetPositionFK, "/compute_fk", fk)

    assert (solved.error_code.val, found.error_code.val) == (Codes.SUCCESS, Codes.SUCCESS)
    assert pose_to_matrix(found.pose_stamped[0].pose) == pytest.approx(T, abs=1e-3)
    fk.fk_link_names = ["no_such_link"]
    assert client.call(GetPositionFK, "/compute_fk", fk).error_code.val == Codes.INVALID_LINK_NAME
    request.ik_request.pose_stamped.pose.position.x += 5.0
    assert client.call(GetPositionIK, "/compute_ik", request).error_code.val == Codes.NO_IK_SOLUTION
    request.ik_request.timeout.sec = -1
    assert "timeout is -1 s, expected >= 0" in client.call(GetPositionIK, "/compute_ik", request).error_code.message


def test_a_state_is_judged_with_its_contacts(client: Client) -> None:
    T = client.arm.kinematics.fk(client.named())
    request = GetStateValidity.Request(group_name=GROUP)
    request.robot_state.joint_state.name = list(client.arm.names)
    request.robot_state.joint_state.position = client.named().tolist()
    free = client.call(GetStateValidity, "/check_state_validity", request)

    scene = PlanningScene()
    scene.world.collision_objects = [client.box(T)]
    assert client.apply(scene)
    blocked = client.call(GetStateValidity, "/check_state_validity", request)

    assert free.valid
    assert not free.contacts
    assert not blocked.valid
    assert {contact.contact_body_2 for contact in blocked.contacts} == {"box"}


@pytest.mark.requirement("B-50")
def test_bodies_are_put_moved_attached_and_detached(client: Client) -> None:
    T = client.arm.kinematics.fk(client.q())
    there = se3.make(None, (0.4, 0.5, 0.9))
    shown = client.ros.hear(MarkerArray, "/motion/scene", QOS_LATCHED)
    scene = PlanningScene()
    scene.world.collision_objects = [client.box(there, edge=0.05)]
    assert client.apply(copy.deepcopy(scene))
    client.ros.spin_until(lambda: shown and "box" in {m.ns for m in shown[-1].markers}, what="the box on /motion/scene")
    assert [body.id for body in client.scene().world.collision_objects] == ["box"]

    moved = CollisionObject(id="box", pose=matrix_to_pose(T), operation=CollisionObject.MOVE)
    scene.world.collision_objects = [moved]
    assert client.apply(scene)
    position = client.scene().world.collision_objects[0].pose.position
    assert (position.x, position.y, position.z) == pytest.approx(tuple(T[:3, 3]))

    held = AttachedCollisionObject(link_name=client.tool, object=CollisionObject(id="box"))
    scene = PlanningScene()
    scene.robot_state.attached_collision_objects = [held]
    assert client.apply(scene)
    seen = client.scene()
    assert not seen.world.collision_objects
    assert [body.object.id for body in seen.robot_state.attached_collision_objects] == ["box"]
    client.ros.spin_until(lambda: client.bench.held() == [f"{SIDE}/box"], what="the box in the hand")

    held.object.operation = CollisionObject.REMOVE
    scene.robot_state.attached_collision_objects = [held]
    assert client.apply(scene)
    seen = client.scene()
    assert [body.id for body in seen.world.collision_objects] == ["box"]
    assert seen.world.collision_objects[0].primitives[0].dimensions == pytest.approx([0.05] * 3)


def test_a_change_is_in_force_all_or_nothing_and_what_may_touch_blocks_nothing(client: Client) -> None:
    scene = PlanningScene()
    scene.world.collision_objects = [
        client.box(se3.make(None, (0.5, 0.5, 1.0)), "a"),
        CollisionObject(id="unknown", operation=CollisionObject.REMOVE),
    ]
    assert not client.apply(scene)
    assert not client.scene().world.collision_objects
    matrix = client.scene().allowed_collision_matrix
    for row in matrix.entry_values:
        row.enabled = [False] * len(row.enabled)
    assert not client.apply(PlanningScene(allowed_collision_matrix=matrix))

    T = client.arm.kinematics.fk(client.named())
    scene = PlanningScene()
    scene.world.collision_objects = [client.box(T)]
    assert client.apply(scene)
    blocked = client.plan(client.joint_goal(client.named()))

    matrix = client.scene().allowed_collision_matrix
    k = list(matrix.entry_names).index("box")
    for i, row in enumerate(matrix.entry_values):
        row.enabled = [True] * len(row.enabled) if i == k else [*row.enabled[:k], True, *row.enabled[k + 1 :]]
    scene = PlanningScene(allowed_collision_matrix=matrix)
    assert client.apply(scene)
    free = client.plan(client.joint_goal(client.named()))

    assert blocked.error_code.val == Codes.GOAL_IN_COLLISION
    assert "box" in blocked.error_code.message
    assert free.error_code.val == Codes.SUCCESS, free.error_code.message


def test_what_is_unknown_not_supported_or_leaves_the_base_out_is_refused_by_name(client: Client) -> None:
    request = client.joint_goal(client.named())
    request.group_name = "no_such_group"
    assert client.plan(request).error_code.val == Codes.INVALID_GROUP_NAME
    request = client.pose_goal(client.arm.kinematics.fk(client.q()))
    request.goal_constraints[0].position_constraints[0].link_name = "no_such_link"
    answer = client.plan(request)
    assert answer.error_code.val == Codes.INVALID_LINK_NAME
    assert "no_such_link" in answer.error_code.message
    request = client.joint_goal(client.named())
    request.pipeline_id = "chomp"
    assert "'chomp'" in client.plan(request).error_code.message
    answer = client.call(QueryPlannerInterfaces, "/query_planner_interface", QueryPlannerInterfaces.Request())
    assert [(p.pipeline_id, list(p.planner_ids)) for p in answer.planner_interfaces] == [("openarm", ["fast"])]

    request = client.joint_goal(client.named())
    request.max_cartesian_speed = 0.1
    answer = client.plan(request)
    assert answer.error_code.val not in (Codes.SUCCESS, Codes.UNDEFINED)
    assert "max_cartesian_speed" in answer.error_code.message
    assert "max_cartesian_speed" in client.group._refused[1]

    request = client.joint_goal(client.named())
    low, high = request.workspace_parameters.min_corner, request.workspace_parameters.max_corner
    low.x, low.y, low.z, high.x, high.y, high.z = 0.2, -1.0, -1.0, 1.0, 1.0, 1.0
    refused = client.plan(request)
    low.x = -0.2
    planned = client.plan(request)
    assert refused.error_code.val == Codes.FAILURE
    assert "leave the robot's base out" in refused.error_code.message
    assert planned.error_code.val == Codes.SUCCESS, planned.error_code.message
