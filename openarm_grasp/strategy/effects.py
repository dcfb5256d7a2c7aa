# SPDX-License-Identifier: Apache-2.0
"""What the state machine asks for, and what it is told: frozen data, no ROS.

A state answers with a recipe, a tuple of effects that are carried out in order; the first that fails ends the recipe.
What came of it returns to the machine as one `Outcome`. Trajectories are opaque here: the planner's, handed back to be
executed.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TypeAlias, TypeVar

from openarm_common.errors import Code
from openarm_common.types import Array
from openarm_grasp.evidence.evidence import Evidence, Verdict
from openarm_grasp.evidence.observation import Frame
from openarm_grasp.planning.candidates import Box, GraspCandidate
from openarm_grasp.planning.options import Option
from openarm_grasp.planning.place import PlaceTarget

Trajectory: TypeAlias = object


# --- what is asked for
@dataclass(frozen=True)
class GraspRequest:
    """A user's wish.

    Attributes:
        label: What to pick; "" takes the detection with the highest score.
        arm: "auto", "left" or "right".
        place: (2,) or (3,) footprint centre, base frame, m; None lets a free spot be chosen.
        dry_run: Plan and report, do not move.
        phase: "all"; "pick": end with the object in the hand; "place": put down what the hand holds.
        place_yaw: Of the object's x axis about the base z, rad (half a turn makes no difference); None: any.
        timeout: s of robot time for all of it; 0: none.
        object_at: (x, y) near which the object stands, base frame, m; None: any of that label.
        leave: (x, y) of objects that stay where they are, base frame, m.
        why: What it is good for, when it is a part of another request.
    """

    label: str
    arm: str = "auto"
    place: tuple[float, ...] | None = None
    dry_run: bool = False
    phase: str = "all"
    place_yaw: float | None = None
    timeout: float = 0.0
    object_at: tuple[float, ...] | None = None
    leave: tuple[tuple[float, float], ...] = ()
    why: str = ""


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
class Observe:
    """Collect `frames` frames of detections that are taken from now on; result `Frames`.

    Attributes:
        frames: How many.
        near: By the camera on the hand instead of the one over the table.
    """

    frames: int
    near: bool = False


@dataclass(frozen=True)
class ToBase:
    """Express frames of detections in the base frame at their stamps; result `Frames`."""

    frames: tuple[Frame, ...]
    frame_id: str


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
class ProbeReach:
    """Ask how near each arm's TCP comes to a pose; result `Reach`."""

    arms: tuple[str, ...]
    T_base_tcp: Array


@dataclass(frozen=True)
class Execute:
    """Follow a planned trajectory; with `carrying`, a hand that closes on nothing stops it (GRASP_LOST)."""

    arm: str
    trajectory: Trajectory
    what: str
    carrying: bool = False


@dataclass(frozen=True)
class MoveLinear:
    """Move the TCP to a pose on a straight line."""

    arm: str
    T_base_tcp: Array
    what: str


@dataclass(frozen=True)
class MoveGripper:
    """Move the fingers to `position` (m a finger) until they are there or push against something.

    Attributes:
        effort: Largest force, N; 0: the driver's limit.
    """

    arm: str
    position: float
    what: str
    effort: float = 0.0


@dataclass(frozen=True)
class Measure:
    """Read the gripper at rest; result `Evidence`.

    Attributes:
        expected: Width between the fingers, m.
        T_base_tcp: (4, 4) planned pose that the TCP error is measured against; None leaves the error 0.
        settle: Longest wait for the fingers to rest, s.
    """

    arm: str
    expected: float
    T_base_tcp: Array | None = None
    settle: float = 0.0


@dataclass(frozen=True)
class Wait:
    """Let robot time pass, s."""

    duration: float


@dataclass(frozen=True)
class Together:
    """Effects that are carried out at the same time."""

    effects: tuple[Effect, ...]


Effect: TypeAlias = (
    GoHome
    | Observe
    | ToBase
    | PlanGrasp
    | PlanPlace
    | ProbeReach
    | Execute
    | MoveLinear
    | MoveGripper
    | Measure
    | Wait
    | Together
)
Effects: TypeAlias = tuple[Effect, ...]


# --- what is told
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


@dataclass(frozen=True)
class Reach:
    """Smallest distance of each arm's TCP from the pose that was asked about, m."""

    distances: Mapping[str, float]


Result: TypeAlias = Frames | Planned | Reach | Evidence
ResultT = TypeVar("ResultT", Frames, Planned, Reach, Evidence)


@dataclass(frozen=True)
class Outcome:
    """What came of a recipe.

    Attributes:
        code: OK, or why the first failing effect failed.
        message: The failure in a sentence.
        results: Of the effects that have one, in order, up to the failing one.
        done: How many effects of the recipe were carried out.
        refusals: Why the planner refused each way, where that is what failed.
    """

    code: Code = Code.OK
    message: str = ""
    results: tuple[Result, ...] = ()
    done: int = 0
    refusals: Mapping[str, Verdict] = field(default_factory=dict[str, Verdict])

    @property
    def ok(self) -> bool:
        """Whether the whole recipe was carried out."""
        return self.code is Code.OK

    def last(self, kind: type[ResultT]) -> ResultT:
        """The newest result of a kind.

        Raises:
            LookupError: When the recipe had none; a fault of the caller.
        """
        for result in reversed(self.results):
            if isinstance(result, kind):
                return result
        raise LookupError(f"no {kind.__name__} among the results {[type(r).__name__ for r in self.results]}")


@dataclass(frozen=True)
class GraspOutcome:
    """The answer to a request.

    Attributes:
        code: OK, or what went wrong.
        message: What happened, in a sentence or two.
        label: What was picked (or asked for).
        arm: The arm that was used, or "".
        attempts: Physical attempts.
        place_position: (3,) target that was used, base frame, m; zeros when none.
        duration: s of robot time.
        held: The object is in the hand.
        moved: It stands elsewhere than before, and not where it was asked for; the message says where.
        route: How it came to its place: "direct", "hand_over" or "push"; "" when it did not.
        options: Ways to grasp that were weighed for the newest plan, by arm, the preferred first.
    """

    code: Code
    message: str
    label: str
    arm: str = ""
    attempts: int = 0
    place_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    duration: float = 0.0
    held: bool = False
    moved: bool = False
    route: str = ""
    options: tuple[Option, ...] = ()

    @property
    def kind(self) -> str:
        """SUCCESS; CANCELLED; PARTIAL: picked, not placed as asked; REFUSED: never touched; FAILED."""
        if self.success:
            return "SUCCESS"
        if self.code is Code.CANCELLED:
            return "CANCELLED"
        if self.held or self.moved:
            return "PARTIAL"
        return "FAILED" if self.attempts else "REFUSED"

    @property
    def success(self) -> bool:
        """Whether what was asked for happened."""
        return self.code is Code.OK
