# SPDX-License-Identifier: Apache-2.0
"""Which arms of the robot in this process are under way, and what room they leave each other. rad, s; time in ns."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.collision import Box
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.beside import Course, least_wait
from openarm_motion.timing.checks import Motion, check_against_others


class Traffic:
    """Motions that have been let in and have not ended.

    Args:
        arms: By name.
    """

    def __init__(self, arms: Mapping[str, Arm]) -> None:
        self._arms = arms
        self._running: dict[str, tuple[Motion, int]] = {}
        self._halted: dict[str, str] = {}

    def arrived(self, arm: str, state: Mapping[str, float]) -> dict[str, float]:
        """Joints with the other arms where their motions end."""
        joints = dict(state)
        for name, (motion, _) in self._running.items():
            if name != arm:
                joints |= dict(zip(motion.names, motion.q[-1].tolist(), strict=True))
        return joints

    def room(
        self,
        arm: Arm,
        motion: Motion,
        t_ns: int,
        state: Mapping[str, float],
        held: Mapping[str, Sequence[Box]],
        max_wait: float,
    ) -> float:
        """How long an arm must rest before a motion, s.

        Args:
            arm: That is to set out.
            motion: Of it, beginning now.
            t_ns: Now.
            state: Present joints.
            held: What arms hold, by name, tool frame.
            max_wait: Longest rest that is proven to keep arms apart, s; 0: a motion begins now, or not at all.

        Raises:
            OpenArmError: IN_COLLISION, when no rest helps.
        """
        if max_wait <= 0.0:
            running = [self._left_of(name, t_ns) for name in self._running if name != arm.name]
            check_against_others(arm, motion, state, running)
            return 0.0
        wide = dict(state)  # hands may open on the way
        for other in self._arms.values():
            wide = other.with_gripper(wide, other.config.planning.gripper_open)
        others = [
            Course(other, self._left_of(name, t_ns), held.get(name, ()))
            if name in self._running
            else Course.standing(other, wide, held.get(name, ()))
            for name, other in self._arms.items()
            if name != arm.name
        ]
        return least_wait(Course(arm, motion, held.get(arm.name, ())), others, wide, max_wait)

    def enter(self, arm: str, motion: Motion, start_ns: int) -> None:
        """A motion begins at a time from now on."""
        self._running[arm] = (motion, start_ns)

    def leave(self, arm: str, t_ns: int, state: Mapping[str, float], *, arrived: bool) -> None:
        """A motion has ended; where it stopped on its way, what others have before them is looked at again."""
        del self._running[arm]
        self._halted.pop(arm, None)
        for name in () if arrived else self._running:
            try:
                check_against_others(self._arms[name], self._left_of(name, t_ns), state, ())
            except OpenArmError as error:
                self._halted[name] = f"the {arm} arm stopped on its way: {error.message}"

    def look_out(self, arm: str, guard: Callable[[], None] | None) -> None:
        """Raise when an arm under way shall stop.

        Raises:
            OpenArmError: IN_COLLISION; from `guard`.
        """
        if guard is not None:
            guard()
        if arm in self._halted:
            raise OpenArmError(Code.IN_COLLISION, self._halted[arm])

    def _left_of(self, name: str, t_ns: int) -> Motion:
        """What an arm under way has before it, beginning now."""
        motion, start_ns = self._running[name]
        return motion.later((start_ns - t_ns) * 1e-9)
