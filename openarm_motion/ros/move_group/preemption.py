# SPDX-License-Identifier: Apache-2.0
"""Goals that move the same joints, one after the other: a newer one ends those before it, as MoveIt's do."""

from __future__ import annotations

from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import asynccontextmanager

from openarm_common.errors import Code, OpenArmError
from openarm_motion.service.robot import RobotInterface, RobotWatch

#: Joints that change by less in this time rest, rad or m and ns; after a goal was ended they have so long for it, s.
_STILL, _OVER_NS, _LONGEST = 2e-3, 100_000_000, 3.0


class Preemption:
    """Lets the newest goal of each joint move it.

    Args:
        robot: Knows whether joints move.
    """

    def __init__(self, robot: RobotInterface) -> None:
        self._robot = robot
        self._newest: dict[str, object] = {}
        self._moving: set[str] = set()

    @asynccontextmanager
    async def take(self, joints: Sequence[str], cancelled: Callable[[], bool]) -> AsyncGenerator[Callable[[], bool]]:
        """End the goals that move some joints, and wait until these rest.

        Args:
            joints: Their names; none: there is nothing to wait for.
            cancelled: Whether to give up.

        Yields:
            Whether to give up, for a newer goal, too.

        Raises:
            OpenArmError: CANCELLED.
        """
        mine = object()
        self._newest.update(dict.fromkeys(joints, mine))
        newer = lambda: any(self._newest[name] is not mine for name in joints)  # noqa: E731
        stopped = lambda: cancelled() or newer()  # noqa: E731
        try:
            if not self._moving.isdisjoint(joints):
                await RobotWatch(self._robot).until(lambda: stopped() or self._moving.isdisjoint(joints))
                await RobotWatch(self._robot).until(lambda: stopped() or self._rest(joints), limit=_LONGEST)
            if stopped():
                raise OpenArmError(Code.CANCELLED, "cancelled before it began")
            self._moving.update(joints)
            try:
                yield stopped
            finally:
                self._moving.difference_update(joints)
        except OpenArmError as error:
            if error.code is Code.CANCELLED and newer():
                raise OpenArmError(error.code, f"{error.message}; a newer goal for the same joints came") from error
            raise

    def _rest(self, joints: Sequence[str]) -> bool:
        now_ns, now = self._robot.states.latest()
        before = self._robot.states.between(now_ns - _OVER_NS, now_ns)[0][1]
        return all(abs(now[name] - before.get(name, now[name])) < _STILL for name in joints if name in now)
