# SPDX-License-Identifier: Apache-2.0
"""Where every frame was at the stamp of an image: joint states over time, fixed edges, forward kinematics.

A lookup is answered at the requested stamp, never with "the latest": between two joint states by the cubic through
their positions and velocities, beyond the newest one within `TOLERANCE_NS`. It is answered only where the error that is
predicted from what was seen is at most `MAX_ERROR` at the frame; everything else is refused, with the figures.

What is seen of a joint between two states is the second derivative of the cubic at both of them, `a`. A straight line
over the gap `h` errs by at most ``a h²/8``, and the cubic by less: that is the prediction where velocities are
measured. Where they are not, each is the slope of the parabola through a state and the two before it (a joint rests
before the first); a joint that starts to move inside the gap shows late there, so the prediction is four times as
large. The prediction of a joint counts times its largest possible distance to the frame, summed over the joints that
move it. What no state can show is a motion there and back inside one gap: for 1 mm in 0.1 s a shoulder needs 2 rad/s²
to and fro, which no planned motion has. Over longer gaps nothing is predicted.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array

TOLERANCE_NS = 5_000_000
#: Two joint states further apart than this are not interpolated between: the arm may have done anything.
MAX_BRACKET_NS = 100_000_000
#: Largest predicted error of the position of a frame, m.
MAX_ERROR = 1e-3
#: Longest name of a joint or frame, characters, and most frames beside the robot's.
LONGEST_NAME, _FRAMES = 256, 1000
#: Share of ``a h²`` that counts as error: with measured velocities, and with those from positions.
_MEASURED, _DERIVED = 1.0 / 8.0, 1.0 / 2.0


@dataclass(frozen=True, eq=False)
class _JointState:
    """Positions and, where they were measured, velocities by joint name."""

    t_ns: int
    names: tuple[str, ...]
    q: dict[str, float]
    v: Mapping[str, float]


class RobotStateBuffer:
    """The joint states of the last seconds and fixed edges in addition to the description.

    Args:
        description: The robot; its root is the base frame.
        capacity: Number of joint states that are kept (400 is 4 s at 100 Hz).
    """

    def __init__(self, description: RobotDescription, capacity: int = 400) -> None:
        self._description = description
        self._endless = [name for name, joint in description.joints.items() if joint.type == "continuous"]
        self._states: deque[_JointState] = deque(maxlen=capacity)
        self._static: dict[str, tuple[str, Array]] = {}
        self._levers_of: dict[tuple[str, tuple[str, ...]], Array] = {}

    def add_joint_state(
        self, t_ns: int, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float] = ()
    ) -> None:
        """Add one joint state; time going back (a restarted simulation) empties the buffer first.

        A second one at the same stamp, of another publisher, is added to the first. Joints that turn without end go on
        from the last state, whatever turn an encoder starts again with.

        Args:
            t_ns: Stamp.
            names: Names of the joints.
            positions: Positions of each joint, rad or m.
            velocities: Velocities of each joint, rad/s or m/s; none, only zeros or NaN: they are not measured.
        """
        if self._states and t_ns < self._states[-1].t_ns:
            self._states.clear()
        q = dict(zip(names, positions, strict=True))
        # a driver without velocities publishes none, zeros or NaN, also while it moves
        v = dict(zip(names, velocities, strict=False)) if any(velocities) else {}
        if not math.isfinite(sum(v.values())):
            v = {}
        for name in self._endless if self._states else ():
            if name in q and name in self._states[-1].q:
                q[name] = float(nearest_turns(q[name], self._states[-1].q[name], math.inf))
        if self._states and t_ns == self._states[-1].t_ns:  # of another publisher
            last = self._states.pop()
            q, v = {**last.q, **q}, {**last.v, **v}
        self._states.append(_JointState(t_ns, tuple(q), q, v if len(v) == len(q) else {}))

    def set_static(self, parent: str, child: str, T_parent_child: Array) -> None:
        """Add or replace a fixed edge, also one above the root, as of a map; the description's own are ignored.

        Args:
            parent: Frame.
            child: Frame.
            T_parent_child: (4, 4), m.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a name that is none, or when there are too many.
        """
        if child == self._description.root and self._static.get(parent, (child,))[0] == child:
            parent, child, T_parent_child = child, parent, se3.inverse(T_parent_child)
        if max(len(parent), len(child)) > LONGEST_NAME or (child not in self._static and len(self._static) >= _FRAMES):
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"frame {brief(child)} has a name of more than {LONGEST_NAME} characters, or is one of more than"
                f" {_FRAMES}",
            )
        if child not in self._description.links:
            self._static[child] = (parent, T_parent_child)
            self._levers_of.clear()

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
        return self._states[-1].t_ns, self._states[-1].q

    def between(self, start_ns: int, end_ns: int) -> list[tuple[int, dict[str, float]]]:
        """Return the joint states from one stamp to another, both included, oldest first."""
        return [(state.t_ns, state.q) for state in self._states if start_ns <= state.t_ns <= end_ns]

    def settled(self, t_ns: int) -> bool:
        """Whether no state that is still to come changes the joints at a stamp: there is one at it, or after it."""
        return bool(self._states) and self._states[-1].t_ns >= t_ns

    def joints_at(self, t_ns: int, frame: str = "") -> dict[str, float]:
        """Return the joint positions at a stamp, rad or m by joint name.

        Args:
            t_ns: Stamp.
            frame: Frame whose position they must give within `MAX_ERROR`; empty: every link.

        Raises:
            OpenArmError: STALE_DATA, when no joint state is near enough and no two bracket the stamp, with the gap; or
                when they may be further off than `MAX_ERROR`, with the prediction.
        """
        if not self._states:
            raise OpenArmError(Code.STALE_DATA, "no /joint_states yet; is the bridge (or the robot driver) running?")
        k = bisect_left(self._states, t_ns, key=lambda state: state.t_ns)
        near = self._states[max(k - 1, 0)], self._states[min(k, len(self._states) - 1)]
        nearest = min(near, key=lambda state: abs(state.t_ns - t_ns))
        gap_ns, bracket_ns = nearest.t_ns - t_ns, near[1].t_ns - near[0].t_ns
        if gap_ns == 0:
            return nearest.q
        if 0 < bracket_ns <= MAX_BRACKET_NS:
            names, q, error = self._interpolate(k, t_ns)
            seen = f"the joint states around it are {bracket_ns / 1e6:.1f} ms apart"
        elif abs(gap_ns) <= TOLERANCE_NS:
            last = len(self._states) - 1
            names, positions, velocities, _ = self._seen(min(max(k, 1), last))
            q = positions[0 if nearest is near[0] and k <= last else 1]
            error = abs(velocities).max(axis=0) * abs(gap_ns * 1e-9)
            seen = f"the nearest joint state is {gap_ns / 1e6:+.1f} ms away"
        else:
            raise OpenArmError(
                Code.STALE_DATA,
                f"no joint state at stamp {t_ns / 1e9:.3f} s: the nearest is {gap_ns / 1e6:+.1f} ms away,"
                f" expected within {TOLERANCE_NS / 1e6:.0f} ms or two that bracket it",
            )
        moved = self._levers(frame, names) * error
        worst = float(moved.sum(axis=1).max(initial=0.0))
        if not worst <= MAX_ERROR:
            raise OpenArmError(
                Code.STALE_DATA,
                f"the joints at stamp {t_ns / 1e9:.3f} s are not known well enough: {seen} and"
                f" {names[int(moved.max(axis=0).argmax())]} moves, which may put {frame or 'the hand'}"
                f" {worst * 1e3:.1f} mm off, expected at most {MAX_ERROR * 1e3:.1f} mm;"
                " publish /joint_states faster (100 Hz), or move slower",
            )
        return dict(zip(names, q.tolist(), strict=True))

    def _interpolate(self, k: int, t_ns: int) -> tuple[tuple[str, ...], Array, Array]:
        """Return names, positions and predicted errors (n,) at a stamp between state k - 1 and state k."""
        names, (start, end), velocities, share = self._seen(k)
        t_a, t_b = self._states[k - 1].t_ns, self._states[k].t_ns
        u, way = (t_ns - t_a) / (t_b - t_a), end - start
        out, into = velocities * ((t_b - t_a) * 1e-9)
        q = start + u * (u * (3.0 - 2.0 * u) * way + (1.0 - u) * ((1.0 - u) * out - u * into))
        # the larger second derivative of the cubic at its two ends, times h²
        return names, q, share * (abs(6.0 * way - 3.0 * (out + into)) + abs(out - into))

    def _seen(self, k: int) -> tuple[tuple[str, ...], Array, Array, float]:
        """Return names, positions and velocities (2, n) at state k - 1 and state k; the share of `a h²` in error."""
        pair = [self._states[max(i, 0)] for i in (k - 1, k)]
        measured = all(state.v for state in pair)
        states = pair if measured else [self._states[max(i, 0)] for i in (k - 3, k - 2)] + pair
        names = states[-1].names
        if any(state.names != names for state in states):
            names = tuple(name for name in names if all(name in state.q for state in states))
        q = np.array([[state.q[name] for name in names] for state in states])
        if measured:
            return names, q, np.array([[state.v[name] for name in names] for state in states]), _MEASURED
        # where there are fewer than four, the joints rested before the first
        h = np.diff([state.t_ns * 1e-9 for state in states])
        h = np.where(h > 0.0, h, max(h[-1], 1e-9))[:, None]
        slope = np.diff(q, axis=0) / h
        return names, q[2:], slope[1:] + np.diff(slope, axis=0) * h[1:] / (h[1:] + h[:-1]), _DERIVED

    def _levers(self, frame: str, names: tuple[str, ...]) -> Array:
        """Return the largest distances (frames, n) at which joints move a frame, m/rad or m/m; empty: all links."""
        key = (frame, names)
        if key not in self._levers_of:
            if len(self._levers_of) >= _FRAMES:  # names that change with each message
                self._levers_of.clear()
            rows: list[list[float]] = []
            for one in [frame] if frame else self._description.links:
                link, T_link_frame = self._carrier(one)
                reach = self._description.reach(link, float(np.linalg.norm(T_link_frame[:3, 3])))
                rows.append([reach.get(name, 0.0) for name in names])
            self._levers_of[key] = np.unique(np.array(rows), axis=0)
        return self._levers_of[key]

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

    def pose(self, frame: str, q: Mapping[str, float]) -> Array:
        """Return the pose (4, 4) of a frame in the root for joint positions, rad or m by joint name.

        Raises:
            OpenArmError: NO_TRANSFORM, as `lookup`.
        """
        link, T_link_frame = self._carrier(frame)
        return self._description.link_pose(link, q) @ T_link_frame

    def knows(self, frame: str) -> bool:
        """Whether a frame is connected to the root."""
        try:
            self._carrier(frame)
        except OpenArmError:
            return False
        return True

    def moves(self, frame: str) -> bool:
        """Whether a moving joint lies between the base and a frame.

        Raises:
            OpenArmError: NO_TRANSFORM, as `lookup`.
        """
        link, _ = self._carrier(frame)
        return any(joint.type != "fixed" for joint in self._description.chain(link))

    def _in_root(self, frame: str, t_ns: int) -> Array:
        return self.pose(frame, self.joints_at(t_ns, frame) if self.moves(frame) else {})

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
