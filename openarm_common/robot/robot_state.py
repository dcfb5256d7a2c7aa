# SPDX-License-Identifier: Apache-2.0
"""Where every frame was at the stamp of an image: joint states over time, fixed edges, forward kinematics.

A lookup is answered at the requested stamp, never with "the latest": the joint state lies within `TOLERANCE_NS` of
the stamp, or is interpolated between two that bracket it. What can't be answered so is refused, with the gap.
"""

from __future__ import annotations

from bisect import bisect_left
from collections import deque
from collections.abc import Sequence

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

TOLERANCE_NS = 5_000_000
#: Two joint states further apart than this are not interpolated between: the arm may have done anything.
MAX_BRACKET_NS = 100_000_000


class RobotStateBuffer:
    """The joint states of the last seconds and fixed edges in addition to the description.

    Args:
        description: The robot; its root is the base frame.
        capacity: How many joint states are kept (400 is 4 s at 100 Hz).
    """

    def __init__(self, description: RobotDescription, capacity: int = 400) -> None:
        self._description = description
        self._states: deque[tuple[int, dict[str, float]]] = deque(maxlen=capacity)
        self._static: dict[str, tuple[str, Array]] = {}

    def add_joint_state(self, t_ns: int, names: Sequence[str], positions: Sequence[float]) -> None:
        """Add one joint state; time going back (a restarted simulation) empties the buffer first.

        Args:
            t_ns: Stamp.
            names: Of the joints.
            positions: Of each joint, rad or m.
        """
        if self._states and t_ns < self._states[-1][0]:
            self._states.clear()
        self._states.append((t_ns, dict(zip(names, positions, strict=True))))

    def set_static(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Add or replace a fixed edge; edges of the description itself are ignored.

        Args:
            parent: Frame.
            child: Frame.
            T_parent_child: (4, 4), m.
        """
        if child not in self._description.links:
            self._static[child] = (parent, T_parent_child)

    def clear(self) -> None:
        """Forget the joint states (the fixed edges stay)."""
        self._states.clear()

    def latest(self) -> tuple[int, dict[str, float]]:
        """Return the newest joint state.

        Raises:
            OpenArmError: NOT_READY, when there is none.
        """
        if not self._states:
            raise OpenArmError(Code.NOT_READY, "no /joint_states yet; is the bridge (or the robot driver) running?")
        return self._states[-1]

    def between(self, start_ns: int, end_ns: int) -> list[tuple[int, dict[str, float]]]:
        """Return the joint states from one stamp to another, both included, oldest first."""
        return [state for state in self._states if start_ns <= state[0] <= end_ns]

    def settled(self, t_ns: int) -> bool:
        """Whether no state that is still to come changes the joints at a stamp: there is one at it, or after it."""
        return bool(self._states) and self._states[-1][0] >= t_ns

    def joints_at(self, t_ns: int) -> dict[str, float]:
        """Return the joint positions at a stamp, rad or m by joint name.

        Raises:
            OpenArmError: STALE_DATA, with the gap, when no joint state is near enough and no two bracket the stamp.
        """
        if not self._states:
            raise OpenArmError(Code.STALE_DATA, "no /joint_states yet; is the bridge (or the robot driver) running?")
        states = list(self._states)
        after = bisect_left(states, t_ns, key=lambda state: state[0])
        near = [states[i] for i in (after - 1, after) if 0 <= i < len(states)]
        nearest = min(near, key=lambda state: abs(state[0] - t_ns))
        if nearest[0] == t_ns:
            return nearest[1]
        if len(near) == 2 and near[1][0] - near[0][0] <= MAX_BRACKET_NS:
            (t_a, a), (t_b, b) = near
            u = (t_ns - t_a) / (t_b - t_a)
            return {name: (1.0 - u) * q + u * b[name] for name, q in a.items() if name in b}
        gap_ns = nearest[0] - t_ns
        if abs(gap_ns) <= TOLERANCE_NS:
            return nearest[1]
        raise OpenArmError(
            Code.STALE_DATA,
            f"no joint state at stamp {t_ns / 1e9:.3f} s: the nearest is {gap_ns / 1e6:+.1f} ms away,"
            f" expected within {TOLERANCE_NS / 1e6:.0f} ms or two that bracket it",
        )

    def lookup(self, target: str, source: str, t_ns: int) -> Array:
        """Return the pose of `source` in `target` at a stamp: ``p_target = T @ p_source``.

        Joint states are needed only when a moving joint lies between the base and one of the two frames.

        Args:
            target: Frame of the result.
            source: Frame whose pose is returned.
            t_ns: Stamp.

        Raises:
            OpenArmError: NO_TRANSFORM, naming the unknown frame and the known ones; STALE_DATA, from `joints_at`.
        """
        T_root_target = self._in_root(target, t_ns)
        T_root_source = self._in_root(source, t_ns)
        return se3.inverse(T_root_target) @ T_root_source

    def moves(self, frame: str) -> bool:
        """Whether a moving joint lies between the base and a frame.

        Raises:
            OpenArmError: NO_TRANSFORM, as `lookup`.
        """
        link, _ = self._carrier(frame)
        return any(joint.type != "fixed" for joint in self._description.chain(link))

    def _in_root(self, frame: str, t_ns: int) -> Array:
        link, T_link_frame = self._carrier(frame)
        q = self.joints_at(t_ns) if self.moves(link) else {}
        return self._description.link_pose(link, q) @ T_link_frame

    def _carrier(self, frame: str) -> tuple[str, Array]:
        """Return the link that a frame is fixed to, and T_link_frame."""
        T = np.eye(4)
        name = frame
        for _ in range(len(self._static) + 1):
            if name in self._description.links:
                return name, T
            if name not in self._static:
                break
            name, T_parent = self._static[name]
            T = T_parent @ T
        known = sorted(self._description.links) + sorted(self._static)
        raise OpenArmError(
            Code.NO_TRANSFORM,
            f"frame {frame!r} is not connected to {self._description.root!r} (stopped at {name!r});"
            f" known frames: {', '.join(known)}",
        )
