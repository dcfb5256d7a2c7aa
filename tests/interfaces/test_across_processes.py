# SPDX-License-Identifier: Apache-2.0
"""Messages, services and actions of interfaces/ pass between processes (they are built without their C++ side)."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest
from control_msgs.action import FollowJointTrajectory
from openarm_interfaces.action import PlanApproach
from openarm_interfaces.msg import ApproachTarget
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionClient
from tf2_msgs.msg import TFMessage
from trajectory_msgs.msg import JointTrajectoryPoint

_PEER = """
import time

import rclpy
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import TransformStamped
from openarm_interfaces.action import PlanApproach
from openarm_interfaces.msg import Refusal
from openarm_interfaces.srv import ComputeIK
from rclpy.action import ActionServer
from tf2_msgs.msg import TFMessage

rclpy.init()
node = rclpy.create_node("peer")
transforms = node.create_publisher(TFMessage, "/transforms", 1)


def compute(request, response):
    response.success = request.position_only
    response.joint_positions = [2.0 * value for value in request.seed]
    response.message = request.arm
    return response


def plan(goal):
    # A goal may arrive before the publisher of feedback has met the client's subscription: what it says then is lost.
    deadline = time.monotonic() + 10.0
    while not node.count_subscribers("/plan/_action/feedback") and time.monotonic() < deadline:
        time.sleep(0.01)
    for number, target in enumerate(goal.request.targets):
        goal.publish_feedback(PlanApproach.Feedback(stage=target.id, tried=number))
    goal.succeed()
    refusals = [Refusal(id=target.id, code="UNREACHABLE") for target in goal.request.targets]
    return PlanApproach.Result(success=False, code="NO_PLAN", chosen=-1, refusals=refusals)


def follow(goal):
    goal.succeed()
    points = goal.request.trajectory.points
    return FollowJointTrajectory.Result(error_code=-5, error_string=str(list(points[-1].positions)))


node.create_service(ComputeIK, "/compute", compute)
servers = ActionServer(node, PlanApproach, "/plan", plan), ActionServer(node, FollowJointTrajectory, "/follow", follow)
message = TFMessage(transforms=[TransformStamped(child_frame_id="tool")])
node.create_timer(0.05, lambda: transforms.publish(message))
print("ready", flush=True)
try:
    rclpy.spin(node)
except (KeyboardInterrupt, rclpy.executors.ExternalShutdownException):
    pass
"""


@pytest.fixture
def peer():
    with subprocess.Popen([sys.executable, "-c", _PEER], stdout=subprocess.PIPE, text=True, env=os.environ) as process:
        assert process.stdout.readline() == "ready\n"
        yield process
        process.send_signal(signal.SIGINT)


def test_a_message_a_service_and_actions_make_the_round_trip(ros, peer) -> None:
    heard = ros.hear(TFMessage, "/transforms", 1)
    ros.spin_until(lambda: heard, what="a transform of the other process")
    assert heard[0].transforms[0].child_frame_id == "tool"

    answer = ros.call(
        ros.node.create_client(ComputeIK, "/compute"), ComputeIK.Request(arm="left", position_only=True, seed=[0.5, -1])
    )
    assert (answer.success, answer.message, list(answer.joint_positions)) == (True, "left", [1.0, -2.0])

    feedback: list[PlanApproach.Feedback] = []
    plan = ActionClient(ros.node, PlanApproach, "/plan")
    goal = PlanApproach.Goal(arm="right", targets=[ApproachTarget(id="top"), ApproachTarget(id="side", score=0.5)])
    result = ros.hear_all(plan, goal, feedback, lambda: len(feedback) == 2)
    assert [(message.stage, message.tried) for message in feedback] == [("top", 0), ("side", 1)]
    assert (result.code, result.chosen, [refusal.id for refusal in result.refusals]) == ("NO_PLAN", -1, ["top", "side"])

    follow = ActionClient(ros.node, FollowJointTrajectory, "/follow")
    trajectory_goal = FollowJointTrajectory.Goal()
    trajectory_goal.trajectory.points = [JointTrajectoryPoint(positions=[0.25, 0.5])]
    _, outcome = ros.send_goal(follow, trajectory_goal)
    result = ros.result(outcome).result
    assert result.error_code == FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED
    assert result.error_string == "[0.25, 0.5]"
    plan.destroy()
    follow.destroy()
