# SPDX-License-Identifier: Apache-2.0
"""What is asked of a grasp, and the answer; no answer says success without evidence."""

from __future__ import annotations

import math
import re
import shlex
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import LONGEST_TEXT, brief, check_length
from openarm_common.types import Array
from openarm_common.wanted import EASIEST, SELECTIONS
from openarm_grasp.config import LEAST_SCALE, DetectConfig
from openarm_grasp.evidence.verdicts import CameraVerdict, HandVerdict
from openarm_grasp.perception.detections import Frame, Sighting, Spot, find
from openarm_grasp.planning.arms import check_arm
from openarm_grasp.requests.state_times import StateTime

if TYPE_CHECKING:
    from openarm_grasp.planning.options import Option

#: Words of a user: which of several, what, and what to put it on or in.
_WORDS = re.compile(rf"\s*(?:(?:the\s+)?({EASIEST})\b)?(.*?)(?:\b(?:on|in):\s*(\S.*))?", re.DOTALL | re.IGNORECASE)
#: These end a request, and one that runs at the same time; nothing else is tried.
ENDS = (Code.CANCELLED, Code.TIMEOUT, Code.ROBOT_LOST, Code.STOPPED)
#: Fields of a request that are texts.
_TEXTS = ("label", "selection", "arm", "phase", "place_on")
#: What a request may ask for.
PHASES = ("all", "pick", "place", "aside")


@dataclass(frozen=True)
class GraspRequest:
    """A request of a user.

    Attributes:
        label: Object to pick: attributes of it, or words that `openarm_common.wanted` knows; "" fits any.
        selection: Selection among those that fit, of `openarm_common.wanted.SELECTIONS`.
        arm: "auto", "left" or "right".
        place: (2,) or (3,) footprint centre, base frame, m; None lets a free spot be chosen.
        dry_run: Plan and report, do not move.
        confirm: Show each plan, and execute it when a person has confirmed it.
        phase: "all"; "pick": end with the object in the hand; "place": put down what the hand holds; "aside": push the
            object away from where it is, so that what it hides or blocks comes free.
        place_yaw: Of the object's x axis about the base z, rad (half a turn makes no difference); None: unconstrained.
        timeout: s of robot time for all of it; 0: none.
        velocity_scale: Share of the limits of the joints, 0.001 to 1; 0: that of the configuration.
        object_at: (x, y) near which the object is, base frame, m; None: any that is called so.
        exclude_near: (x, y) of objects that stay where they are, base frame, m.
        exclude_parts: (n, 2) points of others that do, base frame, m.
        place_choices: (x, y) of which a free one is chosen without a `place`, base frame, m; none: anywhere.
        why: Purpose, when it is a part of another request.
        same: The object, when an earlier part of the request was about it: as it was seen or left then.
        place_on: Object that it is to stand on or in, as `label`; "": the table.
    """

    label: str
    arm: str = "auto"
    place: tuple[float, ...] | None = None
    dry_run: bool = False
    confirm: bool = False
    phase: str = "all"
    place_yaw: float | None = None
    timeout: float = 0.0
    velocity_scale: float = 0.0
    object_at: tuple[float, ...] | None = None
    exclude_near: tuple[Spot, ...] = ()
    exclude_parts: tuple[Array, ...] = ()
    place_choices: tuple[Spot, ...] = ()
    why: str = ""
    same: Sighting | None = None
    place_on: str = ""
    selection: str = ""

    @classmethod
    def of(cls, words: str, **fields: Any) -> GraspRequest:
        """Return the request for words of a user such as `red`, `easiest can`, `red on:blue box` or `red in:tray`."""
        found = _WORDS.fullmatch(words)
        easiest, label, place_on = found.groups(default="") if found else ("", words, "")
        read: dict[str, Any] = {"selection": EASIEST if easiest else "", "place_on": place_on}
        return cls(label.strip(), **read | fields)

    def about(self, same: Sighting) -> GraspRequest:
        """The request, for this object alone; it may have moved since."""
        return replace(self, label=same.target.label, same=same)

    def without(self, *spots: Spot) -> GraspRequest:
        """The request, for another object than those at (x, y), base frame, m."""
        return replace(self, exclude_near=(*self.exclude_near, *spots))

    def find(self, frames: Sequence[Frame], limits: DetectConfig) -> Sighting:
        """The object in frames of the base frame; errors as `perception.detections.find`."""
        return find(
            frames,
            self.label,
            limits,
            selection=self.selection,
            at=self.object_at,
            exclude_near=self.exclude_near,
            exclude_parts=self.exclude_parts,
            same=self.same,
        )

    def cut(self) -> GraspRequest:
        """The request with its texts cut where they are too long to be accepted."""
        return replace(self, **{name: getattr(self, name)[:LONGEST_TEXT] for name in _TEXTS})

    def check(self, arms: Collection[str]) -> None:
        """Refuse an arm, a selection, a phase or a speed that does not exist, and a long text.

        Args:
            arms: Arms of the robot.

        Raises:
            OpenArmError: INVALID_ARGUMENT.
        """
        for name in _TEXTS:
            check_length(getattr(self, name), name)
        check_arm(self.arm, arms)
        if self.place_on and self.place is not None:
            text = f"two places: on:{self.place_on} and {brief(str(self.place))}; give one"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        if self.selection not in SELECTIONS:
            text = f"selection {self.selection!r} does not exist; valid: {', '.join(SELECTIONS[1:])}, or none"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        if self.phase not in PHASES:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"phase {self.phase!r} does not exist; valid: {', '.join(PHASES)}"
            )
        if not (self.velocity_scale == 0.0 or LEAST_SCALE <= self.velocity_scale <= 1.0):
            scale = f"velocity_scale is {self.velocity_scale:g}"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"{scale}, expected {LEAST_SCALE:g} to 1, or 0 for the usual one")


def command(request: GraspRequest) -> str:
    """Return the command line that asks for the same again.

    Objects that stay where they are are left out: the command line has no words for them.
    """
    asked = " ".join(filter(None, (EASIEST if request.selection == EASIEST else "", request.label)))
    words = ["openarm", "pick", *([asked] if asked else [])]
    options: dict[str, Sequence[object] | None] = {
        "--arm": None if request.arm == "auto" else (request.arm,),
        "--at": request.object_at,
        "--place": request.place and (*request.place, 0.0)[:3],
        "--place-on": (request.place_on,) if request.place_on else None,
        "--yaw": None if request.place_yaw is None else (math.degrees(request.place_yaw),),
        "--phase": None if request.phase == "all" else (request.phase,),
        "--time-limit": (f"{request.timeout:g}",) if request.timeout else None,
        "--speed": (f"{request.velocity_scale:g}",) if request.velocity_scale else None,
    }
    for name, values in options.items():
        words += [] if values is None else [name, *map(str, values)]
    return shlex.join([*words, *(["--dry-run"] if request.dry_run else [])])


@dataclass(frozen=True)
class Proof:
    """Why a request counts as done: two kinds of evidence that do not depend on each other.

    Attributes:
        hand: Verdict that the hand held the object, or pushed it along.
        camera: Verdict that the object has left its place, or is seen where it was to be placed.

    Raises:
        OpenArmError: INTERNAL, when one of them says otherwise.
    """

    hand: HandVerdict
    camera: CameraVerdict

    def __post_init__(self) -> None:
        if not (self.hand.ok and self.camera.ok):
            text = f"success without evidence: hand {self.hand.reason!r}, camera {self.camera.reason!r}"
            raise OpenArmError(Code.INTERNAL, text)


@dataclass(frozen=True)
class Feasible:
    """Why a dry run says that a request can be done: it was planned to its end, and nothing was moved."""

    plan: str


@dataclass(frozen=True)
class GraspOutcome:
    """The answer to a request.

    Attributes:
        code: OK, or what went wrong.
        message: A sentence or two on what happened.
        label: Label of the object that was picked (or asked for).
        arm: The arm that was used, or "".
        attempts: Physical attempts.
        place_position: (3,) target that was used, base frame, m; zeros when none.
        object_position: (3,) where the object was seen before it was lifted, or, where an arm moved in vain, since;
            base frame, m; None: it was not.
        duration: s of robot time.
        held: The object is in the hand.
        moved: It is elsewhere than before, and not where it was asked for; the message says where.
        route: Strategy that did it: "direct", "hand_over", "push", "aside" or another one; "" when it was not done.
        options: Grasps that were considered for the newest plan, by arm, the preferred first.
        state_times: Time spent in each state.
        recording: Path of the flight recording of a failure; "" when there is none.
        proof: Why it may say OK; see `succeeded`.

    Raises:
        OpenArmError: INTERNAL, for OK without a proof, or from a plan alone when an arm has moved.
    """

    code: Code
    message: str
    label: str
    arm: str = ""
    attempts: int = 0
    place_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    object_position: tuple[float, float, float] | None = None
    duration: float = 0.0
    held: bool = False
    moved: bool = False
    route: str = ""
    options: tuple[Option, ...] = ()
    state_times: tuple[StateTime, ...] = ()
    recording: str = ""
    proof: Proof | Feasible | None = None

    def __post_init__(self) -> None:
        if self.code is Code.OK and (self.proof is None or (isinstance(self.proof, Feasible) and self.attempts > 0)):
            raise OpenArmError(Code.INTERNAL, f"an answer says OK without evidence: {self.message!r}")

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


@dataclass(frozen=True)
class PairOutcome:
    """The answer to two requests.

    Attributes:
        answers: Answers in the order of the requests; none when they were not taken.
        code: OK, or of the first that failed; CANCELLED, when one of them was.
        message: Sentences on each.
        simultaneous: Both arms worked at the same time.
        duration: s of robot time.
    """

    answers: tuple[GraspOutcome, ...]
    code: Code
    message: str
    simultaneous: bool = False
    duration: float = 0.0

    @classmethod
    def of(
        cls, answers: tuple[GraspOutcome, GraspOutcome], why: str, duration: float, *, simultaneous: bool
    ) -> PairOutcome:
        """The answer to both; `why` they were, or were not, carried out at the same time."""
        codes = [answer.code for answer in answers if not answer.success]
        code = Code.CANCELLED if Code.CANCELLED in codes else next(iter(codes), Code.OK)
        text = "; ".join(f"{answer.label}: {answer.message}" for answer in answers)
        return cls(answers, code, f"{why}. {text}", simultaneous, duration)

    @property
    def recording(self) -> str:
        """Path of the flight recording of the first failure that has one, or ""."""
        return next((answer.recording for answer in self.answers if answer.recording), "")

    @property
    def success(self) -> bool:
        """Whether both happened."""
        return self.code is Code.OK

    @property
    def kind(self) -> str:
        """What both are; else CANCELLED when one is, PARTIAL when one has come somewhere, FAILED."""
        kinds = {answer.kind for answer in self.answers} or {"REFUSED"}
        if len(kinds) == 1:
            return kinds.pop()
        if "CANCELLED" in kinds:
            return "CANCELLED"
        return "PARTIAL" if kinds & {"SUCCESS", "PARTIAL"} else "FAILED"
