# SPDX-License-Identifier: Apache-2.0
"""Questions about single configurations: inverse kinematics with collisions and constraints, contacts, link poses."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_motion.collision.exact import Contact
from openarm_motion.constraints.goals import in_region
from openarm_motion.constraints.regions import OrientationRegion, PositionRegion, TaskRegion, Volume
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.moves import RequestBoxes


@dataclass(frozen=True, eq=False)
class StateVerdict:
    """Whether a configuration is one that a plan may end in, and why not.

    Attributes:
        contacts: Pairs that are nearer than plans keep, the deepest first.
        constraints: Constraints, and how far each is beyond its tolerance, m or rad, times its weight.
        limits: The joint that is beyond its limits, in words; "" where none is.
    """

    contacts: tuple[Contact, ...] = ()
    constraints: tuple[tuple[str, float], ...] = ()
    limits: str = ""

    @property
    def valid(self) -> bool:
        """Whether nothing is wrong."""
        return not self.contacts and not self.limits and all(beyond == 0.0 for _, beyond in self.constraints)


def at_pose(pose: Array, more: TaskRegion) -> TaskRegion:
    """The configurations with the tool at a pose (4, 4), in another region, too."""
    place = PositionRegion("the tool", np.zeros(3), (Volume("sphere", pose, (0.0,)),))
    turn = OrientationRegion("the tool", np.eye(3), pose[:3, :3], (0.0, 0.0, 0.0))
    return TaskRegion(more.joints, (place, *more.positions), (turn, *more.orientations))


def solve(
    arm: Arm,
    now: StartState,
    around: RequestBoxes,
    region: TaskRegion,
    *,
    avoid_collisions: bool,
    end: float = math.inf,
) -> Array:
    """The configuration (n,) in a region that is reached first; without collisions, where they count.

    Args:
        arm: The arm.
        now: Present configuration.
        around: Boxes of the request.
        region: The goal.
        avoid_collisions: Whether they count.
        end: The search ends then, s of the monotonic clock; what is at hand is tried nevertheless.

    Raises:
        PlanFailedError: UNREACHABLE; IN_COLLISION, naming the pair.
    """
    found = in_region(arm, region, now.start, now.scale, end)
    if not avoid_collisions:
        return found[0]
    scene = arm.scene(now.state, around.obstacles, around.attached, environment=now.environment)
    free = next((q for q in found if not scene.collides(q)), None)
    if free is None:
        contact = scene.contacts(found[0])[0]
        text = f"all {len(found)} configurations collide; {contact}"
        raise PlanFailedError(Code.UNREACHABLE, text, "goal", contact)
    return free


def judge(arm: Arm, now: StartState, around: RequestBoxes, region: TaskRegion) -> StateVerdict:
    """Judge where an arm is.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a joint of another arm.
    """
    region.check(arm.names)
    scene = arm.scene(now.state, around.obstacles, around.attached, environment=now.environment)
    contacts = tuple(scene.contacts(now.start)) if scene.collides(now.start) else ()
    pose = arm.kinematics.fk(now.start)
    outside = region.outside(arm.names, now.start[None], pose[None])
    parts = tuple((what, weight * float(b[0])) for (what, b), weight in zip(outside, region.weights, strict=True))
    return StateVerdict(contacts, parts)


def link_poses(
    description: RobotDescription, links: Sequence[str], state: Mapping[str, float], T_base_frame: Array
) -> list[Array]:
    """Poses (4, 4) of links in a frame.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for an unknown link or a joint that the state lacks.
    """
    for link in links:
        if link not in description.links:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no link {link!r}; links: {', '.join(description.links)}")
    T = se3.inverse(T_base_frame)
    return [T @ description.link_pose(link, state) for link in links]
