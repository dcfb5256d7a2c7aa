# SPDX-License-Identifier: Apache-2.0
"""What a client of MoveIt has, before the motion node with a fake robot."""

from __future__ import annotations

import numpy as np
from geometry_msgs.msg import Pose
from moveit_msgs.action import ExecuteTrajectory, MoveGroup
from moveit_msgs.msg import (
    CollisionObject,
    Constraints,
    JointConstraint,
    MotionPlanRequest,
    OrientationConstraint,
    PlanningScene,
    PositionConstraint,
)
from moveit_msgs.srv import ApplyPlanningScene, GetMotionPlan, GetPlanningScene
from rclpy.action import ActionClient
from shape_msgs.msg import SolidPrimitive

from openarm_common.ros.convert import matrix_to_pose

SIDE, GROUP = "right", "right_arm"


class Client:
    """What a client of MoveIt has."""

    def __init__(self, bench) -> None:
        self.bench, self.ros, self.node = bench, bench.ros, bench.ros.node
        self.group = bench.node.companions[0]
        self.arm = bench.node.service.arms[SIDE]
        self.tool = self.arm.kinematics.tool_link
        self.move = ActionClient(self.node, MoveGroup, "/move_action")
        self.execute = ActionClient(self.node, ExecuteTrajectory, "/execute_trajectory")

    def call(self, kind, name: str, request):
        return self.ros.call(self.node.create_client(kind, name), request)

    def plan(self, request: MotionPlanRequest):
        asked = GetMotionPlan.Request(motion_plan_request=request)
        return self.call(GetMotionPlan, "/plan_kinematic_path", asked).motion_plan_response

    def joint_goal(self, q, names=None, group: str = GROUP) -> MotionPlanRequest:
        joints = [
            JointConstraint(joint_name=name, position=float(x), tolerance_above=1e-3, tolerance_below=1e-3, weight=1.0)
            for name, x in zip(names or self.arm.names, q, strict=True)
        ]
        request = MotionPlanRequest(group_name=group, goal_constraints=[Constraints(joint_constraints=joints)])
        request.max_velocity_scaling_factor = request.max_acceleration_scaling_factor = 1.0
        return request

    def pose_constraints(self, T: np.ndarray, tolerance: float = 1e-3, link: str = "") -> Constraints:
        pose, link = matrix_to_pose(T), link or self.tool
        place = PositionConstraint(link_name=link, weight=1.0)
        place.constraint_region.primitives = [SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[tolerance])]
        place.constraint_region.primitive_poses = [Pose(position=pose.position)]
        turn = OrientationConstraint(link_name=link, orientation=pose.orientation, weight=1.0)
        turn.absolute_x_axis_tolerance = turn.absolute_y_axis_tolerance = turn.absolute_z_axis_tolerance = tolerance
        return Constraints(position_constraints=[place], orientation_constraints=[turn])

    def pose_goal(self, T: np.ndarray, tolerance: float = 1e-3) -> MotionPlanRequest:
        request = self.joint_goal(self.q())
        request.goal_constraints = [self.pose_constraints(T, tolerance)]
        return request

    def q(self) -> np.ndarray:
        return self.bench.q(SIDE)

    def named(self, name: str = "official_home") -> np.ndarray:
        state = self.bench.description.group_state(GROUP, name)
        return np.array([state[joint] for joint in self.arm.names])

    def end(self, trajectory) -> np.ndarray:
        message = trajectory.joint_trajectory
        order = [list(message.joint_names).index(name) for name in self.arm.names]
        return np.array(message.points[-1].positions)[order]

    def scene(self) -> PlanningScene:
        return self.call(GetPlanningScene, "/get_planning_scene", GetPlanningScene.Request()).scene

    def box(self, T: np.ndarray, id: str = "box", edge: float = 0.1) -> CollisionObject:
        body = CollisionObject(id=id, pose=matrix_to_pose(T), operation=CollisionObject.ADD)
        body.primitives = [SolidPrimitive(type=SolidPrimitive.BOX, dimensions=[edge] * 3)]
        body.primitive_poses = [Pose()]
        return body

    def apply(self, scene: PlanningScene) -> bool:
        scene.is_diff = scene.robot_state.is_diff = True
        return self.call(ApplyPlanningScene, "/apply_planning_scene", ApplyPlanningScene.Request(scene=scene)).success
