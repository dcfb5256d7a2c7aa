# SPDX-License-Identifier: Apache-2.0
"""Arms on a lift: kinematics, collision shapes and closed forms of the height that is measured, m.

At a height the robot is one without a lift, so all that plans for an arm is as it is. What is made for a height is
kept, since a lift stands still most of the time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.lift import LiftParts
from openarm_common.robot.urdf import Joint
from openarm_motion.collision.exact import CollisionContext, CollisionScene
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.collision.solids import Box
from openarm_motion.kinematics.chain import ArmKinematics
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.timing.trajectory import JointLimits, Trajectory, time_polyline

#: Arms are those of a height that is no further from the measured one, m; heights are multiples of it.
_STEP = 0.0005
#: Heights whose arms are kept.
_KEPT = 8
#: Travel of the lift between two collision checks, m.
_TRAVEL = 0.004


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
        self.description, self.lift = description, lift

        @lru_cache(maxsize=_KEPT)
        def made(steps: int) -> Mapping[str, Arm]:
            return make(description.with_fixed(lift.joint, steps * _STEP))

        self._made = made
        self._height, self._arms = 0.0, made(0)
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
        self._arms, self._height = self._of(position), round(position / _STEP) * _STEP

    def at(self, position: float) -> Mapping[str, Arm]:
        """Return the arms as they are at a position of the lift, m.

        Raises:
            OpenArmError: LIMITS, for one outside the limits.
        """
        check_height(self.description.joint(self.joint), position)
        return self._of(position)

    def _of(self, position: float) -> Mapping[str, Arm]:
        found = self._made(round(position / _STEP))
        for name, arm in found.items():
            arm.static = self._arms[name].static
        return found

    def update(self, arms: Mapping[str, Arm]) -> None:
        """Be the arms of another description of the same robot, at the height that they are at.

        Raises:
            ValueError: Arms that are on no lift.
        """
        if not isinstance(arms, LiftedArms):
            raise ValueError("expected arms on a lift")
        self._made, self.description = arms._made, arms.description
        self._arms = self._of(self._height)
        self.__dict__.pop("motion", None)

    @cached_property
    def motion(self) -> LiftMotion:
        """Plans motions of the lift."""
        return LiftMotion(self.description, self.lift, self)

    def __getitem__(self, name: str) -> Arm:
        return self._arms[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._arms)

    def __len__(self) -> int:
        return len(self._arms)


class LiftMotion:
    """Plans motions of the lift: straight, while both arms and what they hold keep their posture.

    Args:
        description: The robot.
        lift: Its lift.
        arms: Arms at any height, by name.
    """

    def __init__(self, description: RobotDescription, lift: LiftParts, arms: Mapping[str, Arm]) -> None:
        self._joint, self._lift = description.joint(lift.joint), lift
        chains = {name: ArmKinematics(description, arm.kinematics.tool_link) for name, arm in arms.items()}
        self._robots = {n: CollisionRobot(description, chain, arms[n].robot.apart) for n, chain in chains.items()}

    def plan(
        self,
        arms: Mapping[str, Arm],
        now: StartState,
        held: Mapping[str, Sequence[Box]],
        height: float,
        obstacles: Sequence[Box] = (),
    ) -> Trajectory:
        """Plan a motion to a height.

        Args:
            arms: Arms by name, where they are.
            now: State of all joints, and the surroundings.
            held: Boxes that each hand holds, tool frame.
            height: Position of the lift, m.
            obstacles: Boxes in addition, base frame.

        Raises:
            OpenArmError: LIMITS, for a height outside the limits; IN_COLLISION, naming what would be hit and where.
        """
        joint = self._joint
        check_height(joint, height)
        start = float(np.clip(now.state[joint.name], joint.lower, joint.upper))
        steps = max(2, int(np.ceil(abs(height - start) / _TRAVEL)) + 1)
        for name, robot in self._robots.items():
            scene = self._scene(arms[name], robot, now, held.get(name, ()), obstacles)
            for position in np.linspace(start, height, steps).tolist():
                q = np.array([position if n == joint.name else now.state[n] for n in robot.kinematics.names])
                if scene.collides(q):
                    contact = scene.contacts(q)[0]
                    text = f"the lift can't go from {start:.3f} to {height:.3f} m: at {position:.3f} m {contact}"
                    raise PlanFailedError(Code.IN_COLLISION, text, "search", contact)
        values = (joint.velocity, self._lift.acceleration, self._lift.jerk)
        scale = next(iter(arms.values())).scale(now.scale)
        limits = JointLimits(*(np.array([value]) for value in values)).scaled(scale)
        return time_polyline((joint.name,), np.array([[start], [height]]), limits)

    def _scene(
        self, arm: Arm, robot: CollisionRobot, now: StartState, held: Sequence[Box], obstacles: Sequence[Box]
    ) -> CollisionScene:
        certain = (*arm.static, *now.environment.solids)
        fixed = frozenset(body.id for body in certain)
        around = CollisionContext(
            state=now.state,
            boxes=[*certain, *obstacles],
            held=held,
            supports=fixed,
            fixed=fixed,
            clearance=arm.config.clearance,
            map=now.environment.map,
        )
        return CollisionScene(robot, around)


def check_height(joint: Joint, height: float) -> None:
    """Refuse a position of the lift that is outside its limits, m.

    Raises:
        OpenArmError: LIMITS.
    """
    if not joint.lower <= height <= joint.upper:
        text = f"lift is asked for {height:g} m, allowed {joint.lower:g} to {joint.upper:g} m"
        raise OpenArmError(Code.LIMITS, text)
