# SPDX-License-Identifier: Apache-2.0
"""Arms on a lift: kinematics, collision shapes and closed forms of the height that is measured, m.

At a height the robot is one without a lift, so all that plans for an arm is as it is. What is made for a height is
kept, since a lift stands still most of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import lru_cache

from openarm_common.robot.description import RobotDescription
from openarm_motion.planning.arm import Arm

#: Arms are those of a height that is no further from the measured one, m; heights are multiples of it.
_STEP = 0.0005
#: Heights whose arms are kept.
_KEPT = 8


class LiftedArms(Mapping[str, Arm]):
    """The arms at the present height, by name.

    Args:
        description: The robot, with a lift.
        make: Makes the arms of a robot.
    """

    def __init__(self, description: RobotDescription, make: Callable[[RobotDescription], Mapping[str, Arm]]) -> None:
        lift = description.lift
        if lift is None:
            raise ValueError(f"robot {description.name!r} has no lift")
        self.joint = lift.joint

        @lru_cache(maxsize=_KEPT)
        def at(steps: int) -> Mapping[str, Arm]:
            return make(description.with_fixed(lift.joint, steps * _STEP))

        self._at = at
        self._height, self._arms = 0.0, at(0)
        self.follow({lift.joint: lift.home})

    @property
    def height(self) -> float:
        """Position of the lift that the arms are of, m."""
        return self._height

    def follow(self, state: Mapping[str, float]) -> None:
        """Be the arms of the height in a state of the robot's joints; one that does not say it changes nothing.

        Plans that are being made go on with the arms that they have.
        """
        position = state.get(self.joint, self._height)
        if abs(position - self._height) <= _STEP:
            return
        steps = round(position / _STEP)
        found = self._at(steps)
        for name, arm in found.items():
            arm.static = self._arms[name].static
        self._height, self._arms = steps * _STEP, found

    def __getitem__(self, name: str) -> Arm:
        return self._arms[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arms)

    def __len__(self) -> int:
        return len(self._arms)
