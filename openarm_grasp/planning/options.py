# SPDX-License-Identifier: Apache-2.0
"""Results of the grasps that were weighed: the score of each, which was chosen, and why the others were not."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import nan

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import ApproachConfig
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.planning.candidates import GraspCandidate, wide_edges

#: A plan that fails with one of these says that it cannot be done; with any other it was not found out.
NO_WAY = (Code.UNREACHABLE, Code.IN_COLLISION, Code.NO_PLAN, Code.TOO_WIDE)


@dataclass(frozen=True)
class Refusal(Verdict):
    """Why the planner refused a way, and the two bodies that would meet; none, when it is for another reason."""

    bodies: tuple[str, ...] = ()


class NoWayError(OpenArmError):
    """The planner refused every way that it was offered.

    Args:
        code: Code of the one that got furthest.
        message: Its reason, which represents the others.
        refusals: Why each was refused, by id.
    """

    def __init__(self, code: Code, message: str, refusals: Mapping[str, Refusal]) -> None:
        super().__init__(code, message)
        self.refusals = refusals


@contextmanager
def refusals(faults: list[str], what: str = "") -> Generator[None, None, None]:
    """Go on after what cannot be done, by one of `NO_WAY`; its message, after `what`, is added to the faults."""
    try:
        yield
    except OpenArmError as error:
        if error.code not in NO_WAY:
            raise
        faults.append(f"{what}{error.message}")


#: Message of a way that was not evaluated, or not chosen.
NOT_NEEDED = "not needed: another was chosen"


@dataclass(frozen=True)
class Option:
    """One way to take hold of an object with an arm.

    Attributes:
        id: Id of the candidate; label and edge for an edge that the hand does not fit across.
        arm: Arm of the hand.
        score: The higher is preferred; the sum of `parts`.
        parts: Terms of the score.
        limit_margin: Least distance to a joint limit on the way down and up again, rad; NaN: not known.
        code: OK: chosen; "": not needed, another was chosen; else why it was refused.
        message: The same in words.
    """

    id: str
    arm: str
    score: float = 0.0
    parts: Mapping[str, float] = field(default_factory=dict[str, float])
    limit_margin: float = nan
    code: Code | str = ""
    message: str = NOT_NEEDED


#: Options by arm and id, in the order in which they are preferred.
Options = dict[tuple[str, str], Option]


def options_of(arm: str, offered: Sequence[GraspCandidate], target: Detection, limits: ApproachConfig) -> Options:
    """What an arm is offered, before it was planned; and the edges that the hand does not fit across."""
    found: Options = {(arm, c.id): Option(c.id, arm, c.score, c.parts) for c in offered}
    if any(c.apertures is not None for c in offered):
        return found  # on the cloud: there are no edges
    for name, width in wide_edges(target, limits):
        text = f"{width * 1e3:.0f} mm wide; the hand grasps sides up to {limits.max_width * 1e3:.0f} mm"
        found[arm, f"{target.label}/{name}"] = Option(f"{target.label}/{name}", arm, code=Code.TOO_WIDE, message=text)
    return found


def planned(
    options: Options,
    arm: str,
    offered: Sequence[GraspCandidate],
    chosen: int,
    refusals: Mapping[str, Refusal],
    limit_margins: Sequence[float],
) -> Options:
    """The options after a plan; `chosen` is an index of `offered`, -1 when all were refused."""
    found = dict(options)
    for i, candidate in enumerate(offered):
        option = found[arm, candidate.id]
        if i < len(limit_margins):
            option = replace(option, limit_margin=limit_margins[i])
        why = refusals.get(candidate.id)
        if i == chosen:
            option = replace(option, code=Code.OK, message="chosen")
        elif why is not None:
            option = replace(option, code=why.code, message=why.reason.removeprefix(f"{candidate.id}: "))
        found[arm, candidate.id] = option
    return found


def not_placeable(
    options: Options,
    arm: str,
    dropped: Sequence[GraspCandidate],
    failed: GraspCandidate,
    why: Verdict,
) -> Options:
    """The options after the place was refused for one grasp, and for those that would stand there as it does."""
    found = dict(options)
    for candidate in dropped:
        text = why.reason if candidate.id == failed.id else f"it would stand at the place as {failed.id}, and not do"
        if candidate.id == failed.id or found[arm, candidate.id].code == "":
            found[arm, candidate.id] = replace(found[arm, candidate.id], code=why.code, message=text)
    return found
