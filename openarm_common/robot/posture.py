# SPDX-License-Identifier: Apache-2.0
"""The robot at the stamp of an image, answered once nothing that may still arrive can change the answer.

Times `now` and `since` are seconds of one monotonic clock, of deadlines; stamps are nanoseconds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.types import Array

#: Whether a posture needs the joints: only where the frame moves with them, if they can be had, or always.
JointNeed = Literal["none", "optional", "required"]

#: After this long without a joint state none is waited for, s.
_SILENT = 1.0


@dataclass(frozen=True, eq=False)
class Posture:
    """The robot at a stamp.

    Attributes:
        T_base_frame: (4, 4) pose of the frame that was asked for, m.
        joints: Positions by joint name, rad or m; empty when they were not asked for, or are not known.
        held: Boxes that the hands hold.
        lack: Why the joints are not known, where they are optional.
    """

    T_base_frame: Array
    joints: Mapping[str, float]
    held: tuple[HeldBox, ...] = ()
    lack: str = ""


class PostureTracker:
    """Collects joint states and answers where the robot was.

    Args:
        description: The robot.
        wait: Longest wait for what a posture needs, s.
    """

    def __init__(self, description: RobotDescription, wait: float = 0.0) -> None:
        self.buffer = RobotStateBuffer(description)
        #: What the hands hold now.
        self.held: tuple[HeldBox, ...] = ()
        self._root = description.root
        self._wait = wait
        self._received_at = self._listening_since = -math.inf
        self._listening = False

    def listen(self, on: bool, now: float) -> None:
        """Note that joint states arrive from now on, or no longer; old ones are forgotten when they begin to."""
        if on and not self._listening:
            self.buffer.clear()
            self._received_at, self._listening_since = -math.inf, now
        self._listening = on

    def add(
        self, t_ns: int, names: Sequence[str], positions: Sequence[float], now: float, velocities: Sequence[float] = ()
    ) -> None:
        """Add a joint state.

        Args:
            t_ns: Its stamp.
            names: Joints.
            positions: Positions of each, rad or m.
            now: When it arrived, s.
            velocities: Velocities of each, rad/s or m/s, where they are measured.
        """
        self._received_at = now
        self.buffer.add_joint_state(t_ns, names, positions, velocities)

    def age_s(self, now: float) -> float:
        """Return the seconds since a joint state arrived; infinite before the first."""
        return now - self._received_at

    def starting(self, now: float) -> bool:
        """Return whether the first joint states may still be on their way."""
        return now < self._listening_since + self._wait

    def pending(self, frame: str, t_ns: int, since: float, now: float, joints: JointNeed = "required") -> bool:
        """Return whether what may still arrive can change a posture; arguments as for `posture`."""
        in_time = now < since + self._wait
        alive = now < max(self._received_at, self._listening_since) + max(self._wait, _SILENT)
        try:
            due = joints != "none" or self.buffer.moves(frame)
        except OpenArmError:
            return in_time  # the frame is not connected yet
        return due and in_time and alive and self._listening and not self.buffer.settled(t_ns)

    def posture(
        self, frame: str, t_ns: int, since: float, now: float, joints: JointNeed = "required"
    ) -> Posture | None:
        """Look up where a frame was, and the joints; None while what may still arrive can change the answer.

        Of two joint states around the stamp the second one is waited for, however near the first is: the answer
        depends on the stamps alone, not on the order of arrival.

        Args:
            frame: Any that is connected to the robot.
            t_ns: The stamp.
            since: When it was first asked for, s.
            now: s.
            joints: Whether they are needed; those of a frame that moves with them always are.

        Raises:
            OpenArmError: STALE_DATA or NO_TRANSFORM, when nothing that may still arrive can help, or the time is over.
        """
        if self.pending(frame, t_ns, since, now, joints):
            return None
        try:
            T_base_frame = self.buffer.lookup(self._root, frame, t_ns)
        except OpenArmError as error:
            if now < since + self._wait and error.code is Code.NO_TRANSFORM:
                return None
            raise
        if joints == "none":
            return Posture(T_base_frame, {}, self.held)
        try:
            return Posture(T_base_frame, self.buffer.joints_at(t_ns), self.held)
        except OpenArmError as error:
            if joints == "required" or self.starting(now):
                raise
            return Posture(T_base_frame, {}, self.held, error.message)
