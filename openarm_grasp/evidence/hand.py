# SPDX-License-Identifier: Apache-2.0
"""What the joint states say: of a hand, and of a robot that has gone silent."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.types import Array
from openarm_grasp.evidence.verdicts import Evidence

#: Finger speed is the change of position over this time: drivers may report a velocity of 0.
SPEED_WINDOW_NS = 100_000_000


class HandReader:
    """Reads one arm's hand from the joint states.

    Args:
        description: The robot.
        states: Its joint states.
        arm: Arm of the hand.
    """

    def __init__(self, description: RobotDescription, states: RobotStateBuffer, arm: str) -> None:
        self._description = description
        self._states = states
        self.hand = description.hand(arm)
        self.joint = self.hand.joint
        self._tcp = description.tcp_link(arm)

    def finger(self) -> float:
        """Distance of a pad from the middle of the hand, m; 0 is closed.

        Raises:
            OpenArmError: NOT_READY, when there is no joint state, or none of the finger.
        """
        return self._finger_in(self._states.latest()[1])

    def gap(self) -> float:
        """Distance between the fingers, m."""
        return 2.0 * self.finger()

    def gap_speed(self) -> float:
        """Change of the gap over the last tenth of a second, m/s.

        Raises:
            OpenArmError: STALE_DATA, when the joint states do not reach back so far.
        """
        t_ns, q = self._states.latest()
        before = self._states.joints_at(t_ns - SPEED_WINDOW_NS)
        return 2.0 * (self._finger_in(q) - self._finger_in(before)) / (SPEED_WINDOW_NS * 1e-9)

    def T_base_tcp(self) -> Array:
        """(4, 4) pose of the tool centre point."""
        return self._description.link_pose(self._tcp, self._states.latest()[1])

    def evidence(
        self, expected: float, effort: float, T_base_planned: Array | None, pads: tuple[float, ...] = ()
    ) -> Evidence:
        """Everything that the joint states say about holding an object.

        Args:
            expected: Width of the object between the fingers, m.
            effort: Effort of the finger joint, N or N m.
            T_base_planned: (4, 4) where the TCP should be; None leaves its error 0.
            pads: Force on each finger pad, N; empty without a sensor.
        """
        error = 0.0
        if T_base_planned is not None:
            error = float(np.linalg.norm(self.T_base_tcp()[:3, 3] - T_base_planned[:3, 3]))
        return Evidence(
            self.gap(), expected, effort / abs(self.hand.lever), self.gap_speed(), error, pads, self.hand.reach
        )

    def _finger_in(self, q: Mapping[str, float]) -> float:
        if self.joint not in q:
            raise OpenArmError(Code.NOT_READY, f"/joint_states has no {self.joint}; it has {', '.join(sorted(q))}")
        return self.hand.finger(q[self.joint])


class Silence:
    """How long the robot has said nothing, by a wall clock that is passed in.

    A process that was starved of CPU finds old joint states and a clock that has run on; that is not the robot's
    silence. So time between two updates counts only up to `largest_step`.

    Args:
        largest_step: s.
    """

    def __init__(self, largest_step: float) -> None:
        self._largest_step = largest_step
        self._looked_at: float | None = None
        self.newest_ns = -1
        self.seconds = 0.0
        self.went_back = False

    def update(self, now_s: float, newest_ns: int) -> None:
        """Note the newest stamp of a joint state (-1: none yet) at a time of the wall clock."""
        step = 0.0 if self._looked_at is None else min(now_s - self._looked_at, self._largest_step)
        self._looked_at = now_s
        self.seconds = 0.0 if newest_ns != self.newest_ns else self.seconds + step
        self.went_back = self.went_back or newest_ns < self.newest_ns
        self.newest_ns = max(newest_ns, self.newest_ns)

    def check(self, limit: float) -> None:
        """Raise when the robot is lost.

        Args:
            limit: Longest silence after the first joint state, s.

        Raises:
            OpenArmError: ROBOT_LOST.
        """
        if self.newest_ns >= 0 and (self.went_back or self.seconds > limit):
            what = (
                "robot time went back" if self.went_back else f"/joint_states has been silent for {self.seconds:.1f} s"
            )
            raise OpenArmError(Code.ROBOT_LOST, f"{what}: the bridge (or robot driver) has stopped or restarted")
