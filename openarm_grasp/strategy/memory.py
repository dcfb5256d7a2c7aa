# SPDX-License-Identifier: Apache-2.0
"""What the state machine knows: of its surroundings always, of a request while it runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription, Side
from openarm_common.scene.scene import Table
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.evidence import Verdict
from openarm_grasp.evidence.observation import Detection, Sighting
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.options import Options
from openarm_grasp.planning.place import PlaceTarget
from openarm_grasp.planning.routing import ARMS
from openarm_grasp.strategy.effects import Frames, GraspRequest, Planned
from openarm_grasp.strategy.states import Event

ValueT = TypeVar("ValueT")
#: What the outcome of a state's recipe means, and why.
Judgement: TypeAlias = tuple[Event, str]


@dataclass(frozen=True)
class Surroundings:
    """What does not change from request to request.

    Attributes:
        config: Parameters.
        table: Where objects stand.
        shoulders: (x, y) of each arm's shoulder, base frame, m.
    """

    config: GraspConfig
    table: Table
    shoulders: Mapping[str, Sequence[float]]

    @classmethod
    def of(cls, config: GraspConfig, table: Table, robot: RobotDescription) -> Surroundings:
        """Those of a robot at a table."""
        return cls(config, table, {arm: _shoulder(robot, arm) for arm in ARMS})


@dataclass
class Hand:
    """Where the hand stands in the course of one attempt.

    Attributes:
        holding: It holds the object, as far as known.
        at_object: It is around the object or straight above its grasp, so it leaves on a straight line.
        carried: The object is above its place.
        released: The object was put down and let go.
        putting_back: The place is where the object came from, because no other could be reached.
        try_again: What kept it from its place may not do so at the next attempt.
        homed: The arm is home again.
        retreats: Ways home that failed.
        near: How far the second look has come: "", "look", "plan", "go".
        looked: The camera has looked again before the hand goes down.
        looks: Rounds of frames that were looked at after the place.
    """

    holding: bool = False
    at_object: bool = False
    carried: bool = False
    released: bool = False
    putting_back: bool = False
    try_again: bool = False
    homed: bool = False
    retreats: int = 0
    near: str = ""
    looked: bool = False
    looks: int = 0


@dataclass(frozen=True)
class Kept:
    """What a hand kept when its request ended.

    Attributes:
        arm: Whose hand.
        target: The object as it stood before the grasp.
        candidate: How it is held.
    """

    arm: str
    target: Detection
    candidate: GraspCandidate


@dataclass(frozen=True)
class Known:
    """What a request leaves behind when it has ended.

    Attributes:
        sighting: The object as it stood before the grasp, and what else was in view.
        refusals: Why arms were refused for it; empty when one was not.
        place_refused: One of them could grasp, but not place.
    """

    sighting: Sighting
    refusals: Mapping[str, Verdict]
    place_refused: bool


@dataclass
class Memory:
    """The request and all that was learned since it came.

    Attributes:
        request: What is asked for.
        started_ns: When it came, robot time.
        attempt: 1-based number of the running attempt.
        tried: Attempts in which the arm moved.
        detect_rounds: Rounds of frames without a trusted object, this attempt.
        plans_failed: Detections planned for in vain, this attempt.
        used: Ids of the grasps that have failed.
        used_places: Places that could not be reached with the object in the hand.
        failure: The newest failure; None while nothing has failed.
        seen: Frames of the running attempt.
        sighting: The object and its neighbours, base frame.
        arms: Arms that remain to be planned for; the first is being planned.
        refusals: Why each arm could not be planned for.
        place_refused: One of them could grasp, but not place.
        probed: The arms were asked how near they come.
        offered: Candidates that the planner chooses from.
        arm: The arm that is used, "" while none is chosen.
        candidate: The chosen grasp.
        grasp_plan: Its trajectories.
        place_offered: Place targets that the planner chooses from.
        place_target: The chosen one.
        place_plan: Its trajectories.
        hand: Where the hand stands.
        residual: Direction (2,) and how far along it the camera saw the object from where the hand put it.
        kept: What an earlier request left in the hand, to be placed by this one.
        height: Of the object when it was first seen, m; None before that.
        options: How the ways to grasp fared that were weighed for the newest detection.
        moved_from: The object as it stood when the hand was last about to go down.
    """

    request: GraspRequest
    started_ns: int
    attempt: int = 1
    tried: int = 0
    detect_rounds: int = 0
    plans_failed: int = 0
    used: frozenset[str] = frozenset()
    used_places: tuple[PlaceTarget, ...] = ()
    failure: Verdict | None = None
    seen: Frames | None = None
    sighting: Sighting | None = None
    arms: tuple[str, ...] = ()
    refusals: dict[str, Verdict] = field(default_factory=dict[str, Verdict])
    place_refused: bool = False
    probed: bool = False
    offered: tuple[GraspCandidate, ...] = ()
    arm: str = ""
    candidate: GraspCandidate | None = None
    grasp_plan: Planned | None = None
    place_offered: tuple[PlaceTarget, ...] = ()
    place_target: PlaceTarget | None = None
    place_plan: Planned | None = None
    hand: Hand = field(default_factory=Hand)
    residual: tuple[NDArray[np.float64], float] | None = None
    kept: Kept | None = None
    height: float | None = None
    options: Options = field(default_factory=Options)
    moved_from: Detection | None = None

    @property
    def label(self) -> str:
        """What is picked, once it is known; before that, what is asked for."""
        return self.sighting.target.label if self.sighting else self.request.label

    def need_frames(self) -> Frames:
        """The frames; states after DETECT have them."""
        return _need(self.seen, "frames")

    def need_sighting(self) -> Sighting:
        """The sighting; states after TRANSFORM have one."""
        return _need(self.sighting, "sighting")

    def need_candidate(self) -> GraspCandidate:
        """The chosen grasp; states after PLAN have one."""
        return _need(self.candidate, "candidate")

    def need_grasp_plan(self) -> Planned:
        """The plan of the grasp; states after PLAN have one."""
        return _need(self.grasp_plan, "grasp plan")

    def need_place_target(self) -> PlaceTarget:
        """The place, once PLACE has chosen it."""
        return _need(self.place_target, "place target")

    def fail(self, code: Code, reason: str, *, final: bool = False) -> Judgement:
        """Write a failure down; `final` allows no further try."""
        self.failure = Verdict(code, reason)
        return (Event.END if final else Event.AGAIN), reason

    def forget_sight(self) -> None:
        """Start over from the camera."""
        self.seen = self.sighting = self.candidate = self.grasp_plan = self.place_target = self.place_plan = None
        self.arms, self.refusals, self.offered, self.place_offered, self.arm = (), {}, (), (), ""
        self.place_refused = self.probed = False
        self.kept = None
        self.hand = Hand()


def _shoulder(robot: RobotDescription, arm: Side) -> tuple[float, float]:
    """(x, y) of the arm's first joint, base frame, m."""
    first = robot.joint(robot.arm_joints(arm)[0])
    T_base_shoulder = robot.link_pose(first.parent, {}) @ first.T_parent_joint
    return float(T_base_shoulder[0, 3]), float(T_base_shoulder[1, 3])


def _need(value: ValueT | None, what: str) -> ValueT:
    if value is None:
        raise OpenArmError(Code.INTERNAL, f"the grasp machine has no {what} in a state that needs one")
    return value
