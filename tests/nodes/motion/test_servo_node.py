# SPDX-License-Identifier: Apache-2.0
"""The node servo_node next to the motion node, with a fake robot: what it refuses, and who owns an arm."""

from __future__ import annotations

import pytest
from control_msgs.msg import JointJog
from geometry_msgs.msg import TwistStamped
from moveit_msgs.msg import ServoStatus
from moveit_msgs.srv import ServoCommandType
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

pytestmark = pytest.mark.requirement("R-29")

JOINTS = ("openarm_right_joint1", "openarm_right_joint2")


class Client:
    """Publishes commands, and hears statuses and trajectories."""

    def __init__(self, bench, prefix: str = "") -> None:
        self.bench, self.ros, self.node = bench, bench.ros, bench.ros.node
        self.name = f"{prefix}/servo_node"
        self.twists = self.node.create_publisher(TwistStamped, f"{self.name}/delta_twist_cmds", 10)
        self.jogs = self.node.create_publisher(JointJog, f"{self.name}/delta_joint_cmds", 10)
        self.said: list[ServoStatus] = self.ros.hear(ServoStatus, f"{self.name}/status")
        topic = "/right_joint_trajectory_controller/joint_trajectory"
        self.sent: list[JointTrajectory] = self.ros.hear(JointTrajectory, topic)

    def call(self, kind, name: str, request=None):
        return self.ros.call(self.node.create_client(kind, f"{self.name}/{name}"), request or kind.Request())

    def send(self, message, done) -> None:
        """Send a message again and again until something is so."""
        publisher = self.twists if isinstance(message, TwistStamped) else self.jogs

        def ask() -> bool:
            publisher.publish(message)
            return done()

        self.ros.spin_until(ask, what="an answer")

    def refusals(self) -> list[str]:
        """The sentences with which messages were refused."""
        return [one.message for one in self.said if one.code == ServoStatus.INVALID]

    def refusal(self, message) -> str:
        """The sentence with which a message is refused."""
        self.said.clear()
        self.send(message, self.refusals)
        return self.refusals()[0]


def twist(frame: str = "", z: float = 0.1) -> TwistStamped:
    message = TwistStamped()
    message.header.frame_id, message.twist.linear.z = frame, z
    return message


@pytest.fixture
def client(moveit_bench) -> Client:
    return Client(moveit_bench)


def test_commands_are_refused_before_start_and_after_stop(client: Client) -> None:
    jog = JointJog(joint_names=list(JOINTS), velocities=[0.1, 0.0])
    assert "call start_servo" in client.refusal(jog)
    assert client.call(Trigger, "start_servo").success
    client.send(jog, lambda: bool(client.sent))
    assert client.sent[-1].points[-1].velocities == pytest.approx([0.0] * 7)
    assert client.call(SetBool, "pause_servo", SetBool.Request(data=True)).success
    assert "call start_servo" in client.refusal(jog)


WRONG = (
    (JointJog(joint_names=list(JOINTS), velocities=[0.1]), "2 joint_names and 1 velocities"),
    (JointJog(joint_names=["elbow"], velocities=[0.1]), "elbow"),
    (JointJog(joint_names=[JOINTS[0], "openarm_left_joint1"], velocities=[0.1, 0.1]), "one arm"),
    (JointJog(joint_names=[JOINTS[0]] * 2, velocities=[0.1, 0.1]), "different joints"),
    (JointJog(joint_names=[JOINTS[0]], velocities=[float("nan")]), "nan"),
    (JointJog(joint_names=[JOINTS[0]], velocities=[1.5]), "-1 to 1"),
    (JointJog(joint_names=[JOINTS[0]], velocities=[0.1], displacements=[0.1]), "displacements"),
    (JointJog(joint_names=[JOINTS[0]], velocities=[0.1], duration=1.0), "duration"),
    (twist("openarm_right_hand_tcp", float("inf")), "inf"),
    (twist("nowhere"), "nowhere"),
    (twist(), "says no arm"),
)


def test_a_command_that_makes_no_sense_is_refused_by_name_and_one_of_another_type_too(client: Client) -> None:
    assert client.call(Trigger, "start_servo").success
    for message, named in WRONG:
        client.said.clear()  # what is still on its way is of the message before, and has other words
        client.send(message, lambda named=named: any(named in one for one in client.refusals()))
    assert not client.sent
    kind = ServoCommandType.Request
    assert not client.call(ServoCommandType, "switch_command_type", kind(command_type=kind.POSE)).success
    assert client.call(ServoCommandType, "switch_command_type", kind(command_type=kind.JOINT_JOG)).success
    message = twist("openarm_right_hand_tcp")
    client.send(message, lambda: any("switch_command_type" in one for one in client.refusals()))


def test_an_unknown_frame_is_refused_on_the_topic_of_an_arm(moveit_bench) -> None:
    client = Client(moveit_bench, "/right")
    assert client.call(Trigger, "start_servo").success
    assert "nowhere" in client.refusal(twist("nowhere"))


def test_an_arm_is_moved_by_a_goal_or_by_servoing(client: Client) -> None:
    jog = JointJog(joint_names=[JOINTS[0]], velocities=[0.1])
    assert client.call(Trigger, "start_servo").success
    with client.bench.node.service.claims.holding("right", wanted=True):
        assert "moving already" in client.refusal(jog)
    client.send(jog, lambda: bool(client.sent))
    _, future = client.bench.start(client.bench.move_client, client.bench.named("right"))
    client.send(jog, future.done)
    result = future.result().result
    assert result.code == "BUSY"
    assert "is moved by servoing" in result.message
