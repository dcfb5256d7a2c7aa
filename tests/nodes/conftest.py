# SPDX-License-Identifier: Apache-2.0
"""What the tests of the simulation's node share: a bridge in process, and what is heard from it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

SIDE = "right"
#: Simulated seconds a second, where no camera is drawn.
SPEED = 4.0


@pytest.fixture(autouse=True, scope="module")
def frequent_reports() -> Iterator[None]:
    """Nodes report on /diagnostics ten times a second, so that no test waits for the next report."""
    from openarm_common.ros.node import BaseNode

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BaseNode, "REPORT_PERIOD_S", 0.1)
        yield


class Bench:
    """A bridge, and what has been heard from it.

    Where nothing else is asked for, its arms are ideal, and simulated time without cameras goes as fast as it can be
    followed: joint states come 100 times a second of wall time then.

    Joint values of the right arm, rad.
    """

    ARM = tuple(f"openarm_{SIDE}_joint{i}" for i in range(1, 8))
    FINGER = f"openarm_{SIDE}_finger_joint1"
    TCP = f"openarm_{SIDE}_hand_tcp"
    HOME = (-0.2, 2.2, 0.0, 1.2, 0.0, 0.0, 0.4)
    NEAR_HOME = (-0.1, 2.1, 0.1, 1.3, 0.1, 0.1, 0.3)

    def __init__(self, ros, node=None, **parameters: object) -> None:
        # Here, so that the tests of other nodes do not pay for it.
        from sensor_msgs.msg import JointState

        from openarm_common.ros.node import QOS_COMMAND

        self.ros = ros
        self.node = node or ros.add(self.made(**parameters))
        self.joints: list[JointState] = []
        self.joint_arrivals: list[float] = []
        ros.node.create_subscription(JointState, "/joint_states", self._on_joints, QOS_COMMAND)
        ros.spin_until(lambda: self.joints, what="a joint state")

    @staticmethod
    def made(**parameters: object):
        """A bridge with parameters; a dot in a name is written __."""
        from rclpy.parameter import Parameter

        from openarm_sim_bridge.ros import node

        faster = {"speed": SPEED} if parameters.get("images") is False and "controllers" not in parameters else {}
        values = {"profile": "ideal", **faster, **parameters}
        overrides = [Parameter(name.replace("__", "."), value=value) for name, value in values.items()]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(node, "REPORT_PERIOD_S", 0.1)
            return node.MujocoBridge(parameter_overrides=overrides)

    def _on_joints(self, message) -> None:
        self.joints.append(message)
        self.joint_arrivals.append(time.monotonic())

    # --- hearing
    def collect(self, kind: type, topic: str, qos) -> list:
        return self.ros.hear(kind, topic, qos)

    def fresh(self, got: list, n: int = 1) -> list:
        """The next n messages of a list that are later than what is on its way now."""
        self.spin_sim(0.1)
        had = len(got)
        self.ros.spin_until(lambda: len(got) >= had + n, what=f"{n} messages")
        return got[had:]

    def position(self, name: str) -> float:
        return self.joints[-1].position[self.joints[-1].name.index(name)]

    @property
    def arm(self) -> np.ndarray:
        """Positions of the arm's joints."""
        return np.array([self.position(name) for name in self.ARM])

    @property
    def t_ns(self) -> int:
        from openarm_common.ros.convert import stamp_to_ns

        return stamp_to_ns(self.joints[-1].header.stamp)

    def spin_sim(self, seconds: float, timeout: float = 30.0) -> None:
        """Spin until simulated time has gone on."""
        end = self.t_ns + round(seconds * 1e9)
        self.ros.spin_until(lambda: self.t_ns >= end, timeout, f"{seconds} s of simulated time")

    # --- services
    def call(self, kind: type, service: str, /, **fields: object):
        return self.ros.call(self.ros.node.create_client(kind, service), kind.Request(**fields))

    def done(self, kind: type, service: str, /, **fields: object) -> None:
        """Call a service that must succeed."""
        answer = self.call(kind, service, **fields)
        assert answer.success, answer.message

    def inject(self, name: str, parameters: str = "", seed: int = 1) -> None:
        from openarm_interfaces.srv import InjectFault

        self.done(InjectFault, "/sim/inject_fault", name=name, parameters=parameters, seed=seed)

    def clear(self, name: str = "") -> None:
        from openarm_interfaces.srv import ClearFaults

        self.done(ClearFaults, "/sim/clear_faults", name=name)

    def reset(self, **fields: object) -> None:
        from openarm_interfaces.srv import ResetWorld

        self.done(ResetWorld, "/sim/reset_world", **fields)

    # --- actions
    @staticmethod
    def goal(*points: tuple[float, list[float]], names: tuple[str, ...] = ARM, velocities: bool = True, **fields):
        """FollowJointTrajectory.Goal through (seconds, positions)."""
        from builtin_interfaces.msg import Duration
        from control_msgs.action import FollowJointTrajectory
        from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

        message = JointTrajectory(joint_names=list(names))
        for i, (seconds, positions) in enumerate(points):
            point = JointTrajectoryPoint(
                positions=list(positions), time_from_start=Duration(sec=int(seconds), nanosec=round(seconds % 1 * 1e9))
            )
            if velocities and i == len(points) - 1:
                point.velocities = [0.0] * len(positions)
            message.points.append(point)
        return FollowJointTrajectory.Goal(trajectory=message, **fields)

    def follow(self, goal, **kwargs):
        from control_msgs.action import FollowJointTrajectory
        from rclpy.action import ActionClient

        name = f"/{SIDE}_joint_trajectory_controller/follow_joint_trajectory"
        return self.ros.send_goal(ActionClient(self.ros.node, FollowJointTrajectory, name), goal, **kwargs)

    def send_grip(self, command):
        """Send a JointState command to the gripper."""
        from control_msgs.action import ParallelGripperCommand
        from rclpy.action import ActionClient

        client = ActionClient(self.ros.node, ParallelGripperCommand, f"/{SIDE}_gripper_controller/gripper_cmd")
        return self.ros.send_goal(client, ParallelGripperCommand.Goal(command=command))

    def grip(self, position: float):
        """Move the gripper, and return the answer."""
        from sensor_msgs.msg import JointState

        handle, future = self.send_grip(JointState(name=[self.FINGER], position=[position]))
        assert handle.accepted
        return self.ros.result(future)

    def tcp_pose(self) -> np.ndarray:
        """T_world_tcp, (4, 4), of the simulated arm now."""
        world = self.node._simulation.world
        joints = dict(zip(world.joint_names, world.read_joints().position, strict=True))
        return self.node.description.link_pose(self.TCP, joints)

    def posture(self, residual: Callable[[np.ndarray], list[float]]) -> list[float]:
        """Joint positions near home that make a function of the TCP's pose (4, 4) zero."""
        from scipy.optimize import least_squares

        description = self.node.description
        lower, upper = description.limits(self.ARM)

        def of(q: np.ndarray) -> np.ndarray:
            T = description.link_pose(self.TCP, dict(zip(self.ARM, q, strict=True)))
            return np.concatenate([residual(T), 0.01 * (q - self.HOME)])

        found = least_squares(of, self.HOME, bounds=(lower + 0.02, upper - 0.02))
        T = description.link_pose(self.TCP, dict(zip(self.ARM, found.x, strict=True)))
        assert np.abs(residual(T)).max() < 0.02
        return found.x.tolist()


@pytest.fixture
def bridge(ros) -> Callable[..., Bench]:
    """Makes a bench with parameters of the bridge; a dot in a name is written __."""
    return partial(Bench, ros)


@pytest.fixture
def bench(bridge) -> Bench:
    """Without cameras."""
    return bridge(images=False)


@pytest.fixture(scope="module")
def drawn(ros_domain: int) -> Iterator[object]:
    """A bridge with cameras, which the tests of a module share."""
    node = Bench.made()
    yield node
    node.close()
    node.destroy_node()


@pytest.fixture
def seeing(ros, drawn) -> Iterator[Bench]:
    """With cameras, in the world of the beginning."""
    ros.executor.add_node(drawn)
    bench = Bench(ros, drawn)
    yield bench
    bench.clear()
    bench.reset()
    ros.executor.remove_node(drawn)
