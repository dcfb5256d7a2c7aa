# SPDX-License-Identifier: Apache-2.0
"""What controls an arm, as a test heard it: each message with the time at which the middleware sent it."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass

import numpy as np
from control_msgs.msg import JointTrajectoryControllerState
from sensor_msgs.msg import JointState

from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import stamp_to_ns
from openarm_common.ros.node import reliable
from openarm_common.types import Array

#: A test that does not run for a while misses nothing.
_QOS = reliable(2000)


@dataclass(frozen=True)
class Moment:
    """State of the arm's controller.

    Attributes:
        sent_ns: Wall clock of the bridge when it was published.
        t_ns: Robot time.
        reference: (7,) commanded positions, rad.
        velocity: (7,) commanded velocities, rad/s.
        position: (7,) measured positions, rad.
    """

    sent_ns: int
    t_ns: int
    reference: Array
    velocity: Array
    position: Array


class ControlLog(BackgroundNode):
    """Hears /joint_states and the controller of the right arm, in a thread of its own; a context manager.

    Args:
        domain: ROS_DOMAIN_ID of the graph.
    """

    def __init__(self, domain: int) -> None:
        #: Wall clock of the bridge at each /joint_states, ns.
        self.joint_states_ns: list[int] = []
        self.moments: list[Moment] = []
        super().__init__("control_log", domain=domain)
        self._node.create_subscription(
            JointState,
            "/joint_states",
            lambda _, info: self.joint_states_ns.append(info["source_timestamp"]),
            _QOS,
            raw=True,
        )
        topic = "/right_joint_trajectory_controller/controller_state"
        self._node.create_subscription(JointTrajectoryControllerState, topic, self._on_state, _QOS)

    def _on_state(self, message: JointTrajectoryControllerState, info: dict[str, int]) -> None:
        reference, velocity, position = map(
            np.array, (message.reference.positions, message.reference.velocities, message.feedback.positions)
        )
        self.moments.append(
            Moment(info["source_timestamp"], stamp_to_ns(message.header.stamp), reference, velocity, position)
        )

    def wait(self, condition: Callable[[], object], seconds: float, what: str) -> None:
        """Wait until a condition holds."""
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, f"not within {seconds:g} s: {what}"
            time.sleep(0.002)

    def wait_swing(self, speed: float) -> None:
        """Wait until a joint is commanded to move that fast, rad/s."""
        self.moments.clear()
        fast = lambda: self.moments and np.abs(self.moments[-1].velocity).max() > speed  # noqa: E731
        self.wait(fast, 30.0, "an arm that moves fast")

    def robot_time_at(self, sent_ns: int) -> int:
        """Robot time of the last state that was published before a time of the wall clock, ns."""
        self.wait(lambda: self.moments and self.moments[-1].sent_ns > sent_ns, 20.0, "the state of the controller")
        return next(m.t_ns for m in reversed(self.moments) if m.sent_ns <= sent_ns)

    def from_on(self, t_ns: int, seconds: float) -> list[Moment]:
        """Wait for so much of the robot's time after `t_ns`, and return it."""
        end_ns = t_ns + round(seconds * 1e9)
        self.wait(lambda: self.moments[-1].t_ns >= end_ns, 30.0, f"{seconds:g} s of robot time")
        return [m for m in list(self.moments) if t_ns < m.t_ns <= end_ns]


def last_move_ns(moments: Sequence[Moment]) -> int:
    """Robot time of the last change of the reference; that of the first moment when there is none."""
    at = [a.t_ns for a, b in zip(moments[1:], moments, strict=False) if np.abs(a.reference - b.reference).max() > 1e-9]
    return at[-1] if at else moments[0].t_ns


@contextmanager
def hanging(*pids: int) -> Iterator[None]:
    """Processes that are stopped meanwhile."""
    with ExitStack() as stack:
        for pid in pids:
            os.kill(pid, signal.SIGSTOP)
            stack.callback(os.kill, pid, signal.SIGCONT)
        yield
