# SPDX-License-Identifier: Apache-2.0
"""The node `mujoco_bridge` in process: trajectories of an arm and position commands."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from contextvars import copy_context
from functools import partial

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance, JointTrajectoryControllerState
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory
from unique_identifier_msgs.msg import UUID

from openarm_bringup import cli
from openarm_bringup.commands import connect
from openarm_bringup.ros import peer as peer_client
from openarm_bringup.ros.peer import Peer
from openarm_common.ros.client import new_context
from openarm_common.ros.convert import ns_to_stamp, stamp_to_ns
from openarm_common.ros.holds import Holder
from openarm_common.ros.node import QOS_COMMAND
from openarm_control.ros.trajectory_server import trajectory_of
from tests.conftest import DEADLINE_S
from tests.nodes.conftest import Bench


def test_stamps_and_tolerances_of_a_goal_are_those_of_the_trajectory() -> None:
    goal = Bench.goal((0.5, Bench.HOME), (1.0, Bench.NEAR_HOME))
    goal.trajectory.header.stamp = ns_to_stamp(12_500_000_000)
    goal.goal_time_tolerance.sec = 2
    goal.path_tolerance = [JointTolerance(name=Bench.ARM[1], position=0.1)]
    goal.goal_tolerance = [JointTolerance(name=Bench.ARM[2], position=0.2)]
    trajectory = trajectory_of(goal)
    assert (trajectory.start_ns, trajectory.goal_time_s) == (12_500_000_000, 2.0)
    assert trajectory.path_tolerance == {Bench.ARM[1]: 0.1}
    assert trajectory.goal_tolerance == {Bench.ARM[2]: 0.2}
    assert (trajectory.names, trajectory.t.tolist()) == (Bench.ARM, [0.5, 1.0])


def test_the_topics_of_the_trajectory_controller(bench) -> None:
    """joint_trajectory is followed without an action; controller_state tells reference and feedback."""
    controller = "/right_joint_trajectory_controller"
    states = bench.collect(JointTrajectoryControllerState, f"{controller}/controller_state", 10)
    publisher = bench.ros.node.create_publisher(JointTrajectory, f"{controller}/joint_trajectory", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count() and states, what="the controller's topics")
    assert states[-1].joint_names == list(bench.ARM)
    np.testing.assert_allclose(states[-1].feedback.positions, bench.HOME, atol=0.01)
    publisher.publish(bench.goal((1.0, [*bench.NEAR_HOME[:6], float("nan")])).trajectory)  # refused, in the log
    publisher.publish(bench.goal((1.0, bench.NEAR_HOME)).trajectory)
    bench.ros.spin_until(lambda: np.allclose(bench.arm, bench.NEAR_HOME, atol=0.02), what="the arm to arrive")
    bench.ros.spin_until(
        lambda: np.allclose(states[-1].reference.positions, bench.NEAR_HOME, atol=1e-6), what="its state"
    )
    np.testing.assert_allclose(states[-1].error.positions, 0.0, atol=0.02)
    assert np.all(np.diff([stamp_to_ns(m.header.stamp) for m in states]) >= 0)


Result = FollowJointTrajectory.Result


@pytest.mark.requirement("P-21")
def test_bad_trajectories_end_with_the_joint_and_the_value(bench) -> None:
    near, arm = bench.NEAR_HOME, bench.ARM
    too_far = (*near[:3], 3.0, *near[4:])
    for points, names, code, text in (
        ([(1.0, near)], (*arm[:6], "elbow"), Result.INVALID_JOINTS, "unknown joint 'elbow'"),
        ([(1.0, too_far)], arm, Result.INVALID_GOAL, "position of openarm_right_joint4 at point 0 is 3.0000"),
        ([], arm, Result.INVALID_GOAL, "no points"),
    ):
        answer = bench.ros.result(bench.follow(bench.goal(*points, names=names))[1])
        assert (answer.status, answer.result.error_code) == (GoalStatus.STATUS_ABORTED, code)
        assert text in answer.result.error_string
    assert np.abs(bench.arm - bench.HOME).max() < 0.01


@pytest.mark.requirement("P-21")
def test_cancel_holds(bench) -> None:
    far = [bench.HOME[0] + 2.0, *bench.HOME[1:]]
    handle, future = bench.follow(bench.goal((30.0, far)))
    bench.ros.spin_until(lambda: bench.arm[0] > bench.HOME[0] + 0.05, what="the arm to move")
    bench.ros.result(handle.cancel_goal_async())
    assert bench.ros.result(future).status == GoalStatus.STATUS_CANCELED
    bench.spin_sim(0.3)
    held = bench.arm
    assert np.abs(held - bench.HOME).max() > 0.02
    assert np.abs(held - far).max() > 0.02
    bench.spin_sim(1.0)
    np.testing.assert_allclose(bench.arm, held, atol=0.003)


@pytest.mark.requirement("A-25", "P-21")
def test_a_trajectory_is_followed_until_a_newer_one_takes_over_and_a_bad_one_does_not(bench) -> None:
    _, first = bench.follow(bench.goal((60.0, bench.NEAR_HOME)))
    bench.spin_sim(0.5)
    _, bad = bench.follow(bench.goal())
    assert bench.ros.result(bad).status == GoalStatus.STATUS_ABORTED
    assert not first.done()
    feedback: list = []
    handle, second = bench.follow(bench.goal((1.0, bench.NEAR_HOME)), feedback_callback=feedback.append)
    assert handle.accepted
    assert "newer" in bench.ros.result(first).result.error_string
    bench.ros.spin_until(lambda: feedback, what="feedback")
    answer = bench.ros.result(second)
    assert answer.status == GoalStatus.STATUS_SUCCEEDED, answer.result.error_string
    assert answer.result.error_code == FollowJointTrajectory.Result.SUCCESSFUL
    np.testing.assert_allclose(bench.arm, bench.NEAR_HOME, atol=0.02)
    assert feedback[-1].feedback.joint_names == list(bench.ARM)
    assert abs(feedback[-1].feedback.error.positions[0]) < 0.05


def test_a_blocked_arm_ends_with_its_tolerance_and_holds(bench) -> None:
    below_table = bench.posture(lambda T: [*(T[:3, 3] - [0.30, -0.25, 0.30])])
    _, future = bench.follow(bench.goal((3.0, below_table)))
    answer = bench.ros.result(future)
    assert answer.status == GoalStatus.STATUS_ABORTED
    assert answer.result.error_code == FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED
    assert "openarm_right_joint" in answer.result.error_string
    bench.spin_sim(0.5)
    assert bench.tcp_pose()[2, 3] > 0.38
    assert np.abs(bench.joints[-1].effort).max() < 5.0  # it does not go on pushing


# --- commands
@pytest.mark.requirement("A-16", "A-23", "B-55")
def test_position_commands_may_be_partial_and_unknown_names_are_ignored(bench) -> None:
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count())
    publisher.publish(JointState(name=["openarm_right_joint4", "tail", bench.FINGER], position=[1.5, 9.0, 0.02]))
    bench.ros.spin_until(
        lambda: (
            abs(bench.position("openarm_right_joint4") - 1.5) < 0.01
            and abs(bench.position(bench.FINGER) - 0.02) < 0.001
        ),
        what="the joints to arrive",
    )
    assert bench.node._face._controllers._warned == {"tail"}
    velocities = [m.velocity[m.name.index("openarm_right_joint4")] for m in bench.joints]
    assert max(velocities) < 1.2 * bench.node.config.trajectory.command_velocity  # no jump
    assert bench.position("openarm_right_joint1") == pytest.approx(bench.HOME[0], abs=0.01)


@pytest.mark.requirement("A-16")
def test_an_arm_moves_by_a_stream_of_commands(bench, ros_domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """As docs/interfaces.md says: one command is held for half a second, a stream until it ends."""
    monkeypatch.setattr(peer_client, "_FIRST_NODE_S", DEADLINE_S)
    joint, far = bench.ARM[3], 2.3
    fields = f"{{name: [{joint}], position: [{far}]}}"
    context = new_context(ros_domain)

    def publish(*words: str) -> int:
        connect.PEER.set(partial(Peer, context, settled=True))
        return cli.run(["topic", "pub", "/joint_commands", fields, *words])

    with Peer(context, settled=True) as resident, ThreadPoolExecutor() as threads:
        assert resident.spin_until(lambda: "/joint_commands" in resident.topics(), DEADLINE_S)
        alone = threads.submit(copy_context().run, publish, "--once")
        bench.ros.spin_until(alone.done, what="the end of one command")
        assert alone.result() == 0
        bench.spin_sim(0.7)
        assert bench.HOME[3] < bench.position(joint) < far - 0.1, "it stopped where the command ended"
        stream = threads.submit(copy_context().run, publish, "--rate", "50", "--duration", "0.6")
        bench.ros.spin_until(stream.done, what="the end of the stream")
        assert stream.result() == 0
    context.try_shutdown()
    bench.ros.spin_until(lambda: abs(bench.position(joint) - far) < 0.02, what="the arm to arrive")


def test_bad_position_commands_are_refused_as_a_whole(bench) -> None:
    publisher = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(lambda: publisher.get_subscription_count())
    for bad in (float("nan"), 99.0):
        publisher.publish(JointState(name=["openarm_right_joint4", "openarm_right_joint1"], position=[1.5, bad]))
    bench.spin_sim(0.5)
    assert bench.position("openarm_right_joint4") == pytest.approx(bench.HOME[3], abs=0.01)


@pytest.mark.requirement("P-21")
def test_a_held_arm_and_its_hand_follow_their_holder_alone(bench) -> None:
    holder = Holder(bench.node)
    holder.name = "the grasp node (a grasp of 'red')"
    commands = bench.ros.node.create_publisher(JointState, "/joint_commands", QOS_COMMAND)
    bench.ros.spin_until(commands.get_subscription_count, what="the bridge")

    holds = bench.node._face._controllers.holds._holds

    def ask(arm: str, goal_id: UUID | None = None) -> tuple[int, str]:
        holder.hold(arm)
        bench.ros.spin_until(lambda: holds.key_of(arm, time.monotonic()), what="the hold")
        result = bench.ros.result(bench.follow(bench.goal((1.0, bench.NEAR_HOME)), goal_uuid=goal_id)[1]).result
        return result.error_code, result.error_string

    code, text = ask("right")
    assert code == Result.INVALID_GOAL
    assert text.startswith("BUSY: the right arm is held by the grasp node (a grasp of 'red')")
    before, refused = bench.arm.copy(), bench.node._face._controllers.holds.refused
    commands.publish(JointState(name=[bench.ARM[3], bench.FINGER], position=[1.5, 0.02]))
    bench.ros.spin_until(lambda: bench.node._face._controllers.holds.refused > refused, what="the command")
    assert bench.grip(0.02).status == GoalStatus.STATUS_ABORTED
    bench.spin_sim(0.3)
    np.testing.assert_allclose(bench.arm, before, atol=0.005)
    assert bench.position(bench.FINGER) < 0.005

    assert ask("right", holder.goal_id())[0] == Result.SUCCESSFUL
    holder.release()
    bench.ros.spin_until(lambda: not holds.key_of("right", time.monotonic()), what="the release")
    assert bench.grip(0.02).status == GoalStatus.STATUS_SUCCEEDED
