# SPDX-License-Identifier: Apache-2.0
"""What a robot is asked to do, and what it answers: frozen data, no ROS.

Trajectories are opaque here: the planner's, handed back to be executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias

from openarm_common.types import Array
from openarm_grasp.evidence.evidence import Verdict
from openarm_grasp.evidence.observation import Frame
from openarm_grasp.planning.candidates import Box, GraspCandidate
from openarm_grasp.planning.place import PlaceTarget

Trajectory: TypeAlias = object


@dataclass(frozen=True)
class GoHome:
    """Move the arms that are not there to their home posture, one after the other.

    Attributes:
        arms: Which.
        obstacles: Boxes to keep clear of, base frame.
        back_off_below: A hand lower than this (z, base frame, m) may be among the objects and first backs off along its
            own approach axis.
    """

    arms: tuple[str, ...]
    obstacles: tuple[Box, ...] = ()
    back_off_below: float = float("-inf")


@dataclass(frozen=True)
class PlanGrasp:
    """Choose and plan one of the candidates with one arm; result `Planned`.

    Attributes:
        gone: Where the object will not stand any more then: the map still shows it there.
    """

    arm: str
    candidates: tuple[GraspCandidate, ...]
    obstacles: tuple[Box, ...]
    target: Box
    gone: tuple[Box, ...] = ()


@dataclass(frozen=True)
class PlanPlace:
    """Choose and plan one of the place targets; result `Planned`.

    Attributes:
        held: What the hand carries, TCP frame.
        after: Trajectory whose end is the start; None starts at the present joints.
        gone: Where the object stood: the map may not know yet that it was taken away.
    """

    arm: str
    targets: tuple[PlaceTarget, ...]
    obstacles: tuple[Box, ...]
    held: Box
    after: Trajectory | None = None
    gone: tuple[Box, ...] = ()


@dataclass(frozen=True)
class MoveLinear:
    """Move the TCP to a pose on a straight line."""

    arm: str
    T_base_tcp: Array
    what: str


@dataclass(frozen=True)
class Frames:
    """Frames of detections, oldest first, and the frame they are expressed in."""

    frames: tuple[Frame, ...]
    frame_id: str


@dataclass(frozen=True)
class Planned:
    """A plan: which of the offered ways was chosen, and its three trajectories.

    Attributes:
        chosen: Index of the way.
        transfer: Free path to the beginning of the approach.
        approach: Straight line to where it grasps or lets go.
        retreat: Straight line away.
        planning_time: s of wall clock.
        refusals: Why others were refused, by id.
        limit_margins: Of each way, how near it comes to a joint limit, rad; NaN: refused or not looked at. Empty when
            the planner does not say.
    """

    chosen: int
    transfer: Trajectory
    approach: Trajectory
    retreat: Trajectory
    planning_time: float = 0.0
    refusals: Mapping[str, Verdict] = field(default_factory=dict[str, Verdict])
    limit_margins: tuple[float, ...] = ()
