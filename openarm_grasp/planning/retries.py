# SPDX-License-Identifier: Apache-2.0
"""What a failed grasp leaves to the next attempt: which grasps would repeat it, and what to change for its cause.

After another observation a name says nothing: the axes of a cube may have been swapped. So a failed grasp is the pose
of the hand relative to where the object stood, and the gripper is the same after half a turn about its approach.
Base frame, m, rad.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import acos, cos, radians

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.hand import HandParts
from openarm_common.types import Array
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import GraspCandidate, propose

#: A grasp is repeated by a hand whose opening axis and approach are both turned by less, rad, displaced by less, m.
SAME_ANGLE, SAME_POSITION = radians(10.0), 0.005
#: A higher grasp is higher by this, m: twice what counts as the same.
RAISE = 2.0 * SAME_POSITION
#: Below what every tilt costs: a higher grasp holds less, and comes last; after a collision it comes first.
_RAISED, _RAISED_AFTER_COLLISION = -1.6, 0.1
#: Fingers at the same sides again, at another tilt or height.
_SAME_SIDES = -0.3
#: What has turned in the hand is held nearer to its weight next: after each loss the lever counts so much more.
_LOST = 2.0
#: The weight is farther from the hand than this towards the end that hung lower, m; cosine of ends that are opposite.
_FARTHER, _OPPOSITE = 0.01, -0.9
#: A hand that met something on its way stays higher next: what it is lower than that costs so much, per m.
_LOW = 60.0
#: It met something, or could not get to the grasp for it.
_MET = (Code.HAND_COLLISION, Code.EXECUTION_FAILED)


@dataclass(frozen=True)
class FailedGrasp:
    """A grasp that has failed.

    Attributes:
        code: Why.
        arm: Arm of the hand.
        R_base_tcp: (3, 3) orientation of the hand.
        offset: (3,) of its TCP from the middle of the object's lower face.
        heavy: (2,) direction of the end of the object that hung lower than it should; None: not seen.
    """

    code: Code
    arm: str
    R_base_tcp: Array
    offset: Array
    heavy: Array | None = None

    @classmethod
    def of(
        cls, code: Code, arm: str, candidate: GraspCandidate, target: Detection, heavy: Array | None = None
    ) -> FailedGrasp:
        """Remember a grasp of the object where it was seen."""
        return cls(code, arm, candidate.T_base_tcp[:3, :3], _offset(candidate, target), heavy)

    def repeated_by(self, candidate: GraspCandidate, target: Detection) -> bool:
        """Whether a grasp of the object, where it is seen now, is the same, as far as can be told."""
        R = candidate.T_base_tcp[:3, :3]
        alike = self.sides(candidate) > cos(SAME_ANGLE) and _angle(R[:, 2], self.R_base_tcp[:, 2]) < SAME_ANGLE
        return alike and float(np.linalg.norm(_offset(candidate, target) - self.offset)) < SAME_POSITION

    def sides(self, candidate: GraspCandidate) -> float:
        """How far the fingers are at the same sides: 1 on the same, 0 a quarter turn from them."""
        return abs(float(candidate.T_base_tcp[:3, 1] @ self.R_base_tcp[:, 1]))


@dataclass(frozen=True)
class Ways:
    """Grasps to choose from, best first: those that no failed one resembles, and those that would repeat one."""

    fresh: tuple[GraspCandidate, ...]
    repeats: tuple[GraspCandidate, ...]


def proposed(
    target: Detection,
    config: GraspConfig,
    hand: HandParts,
    failed: Sequence[FailedGrasp],
    *,
    shoulder_xy: Sequence[float] = (0.0, 0.0),
    others: Sequence[Detection] = (),
) -> tuple[GraspCandidate, ...]:
    """Propose grasps of a box or a cylinder for the next attempt.

    After a collision the hand first stays higher; else a higher grasp is what is left when all others are refused.
    Lower than it is, no grasp can be: tips, pads or palm decide.

    Args:
        target: The object as it is seen now.
        config: Parameters.
        hand: Measures of the gripper.
        failed: Grasps that have failed so far.
        shoulder_xy: Same as for `propose`.
        others: Same as for `propose`.

    Raises:
        OpenArmError: TOO_WIDE, when no side fits into the hand.
    """
    offered = propose(target, config, hand, shoulder_xy=shoulder_xy, others=others)
    if not failed:
        return offered
    height = _RAISED_AFTER_COLLISION if has_met(failed) else _RAISED
    higher = propose(target, config, hand, shoulder_xy=shoulder_xy, others=others, raised=RAISE)
    raised = (replace(one, score=one.score + height, parts={**one.parts, "raised": height}) for one in higher)
    return (*offered, *raised)


def has_met(failed: Sequence[FailedGrasp]) -> bool:
    """Whether a hand has met something beside an object: it may be wider below its top than it looks."""
    return any(one.code is Code.HAND_COLLISION for one in failed)


def among(offered: Sequence[GraspCandidate], target: Detection, failed: Sequence[FailedGrasp]) -> Ways:
    """Rank grasps that a sampler has found for the next attempt: fingers go to other sides first.

    What has slipped or turned in the hand is held where its weight pulls less, and a hand that met something goes less
    deep.

    Args:
        offered: Best first.
        target: The object as it is seen now.
        failed: Grasps that have failed so far.
    """
    if not failed:
        return Ways(tuple(offered), ())
    ranked: list[GraspCandidate] = []
    lost = sum(past.code is Code.GRASP_LOST for past in failed)
    for one in offered:
        score = _SAME_SIDES * max(past.sides(one) for past in failed)
        score += _LOST * lost * weight_cost(one)
        if one.apertures is not None:  # boxes have raised grasps of their own
            height = _offset(one, target)[2]
            wanted = max((past.offset[2] + RAISE for past in failed if past.code in _MET), default=height)
            score -= _LOW * max(0.0, wanted - height)
        ranked.append(replace(one, score=one.score + score, parts={**one.parts, "retry": score}))
    ranked.sort(key=lambda c: -c.score)
    again = [any(past.repeated_by(one, target) for past in failed) for one in ranked]
    fresh = tuple(one for one, is_repeat in zip(ranked, again, strict=True) if not is_repeat)
    return Ways(fresh, tuple(one for one, is_repeat in zip(ranked, again, strict=True) if is_repeat))


def weight_cost(one: GraspCandidate) -> float:
    """Part of the score (0 or less) for the distance of the hand from the weight of the object; 0 for boxes."""
    return one.parts.get("lever", 0.0) + one.parts.get("aside", 0.0)


def centre_of_mass(solid: Array, target: Detection, failed: Sequence[FailedGrasp]) -> Array:
    """Where the weight of an object is, as far as known: at first its density is taken to be even.

    When an end of it has hung lower than it should, its weight is between the hand and that end: halfway, and by halves
    again after the next grasp that has turned.

    Args:
        solid: (n, 3) points that fill it, base frame.
        target: The object as it is seen now.
        failed: Grasps that have failed so far.

    Returns:
        (3,) base frame.
    """
    foot, centre = target.foot, np.asarray(solid.mean(axis=0), dtype=np.float64)
    turned = [(past.heavy, past.offset[:2]) for past in failed if past.heavy is not None]
    for heavy, offset in turned:
        held, now = float(offset @ heavy), float((centre - foot)[:2] @ heavy)
        ends = [float(q @ heavy) for other, q in turned if float(other @ heavy) < _OPPOSITE]
        end = min([float(((solid - foot)[:, :2] @ heavy).max()), *ends])
        if now < held + _FARTHER:
            centre[:2] += (0.5 * (held + max(held, end)) - now) * heavy
    return centre


def arms_to_try(arms: Sequence[str], failed: Sequence[FailedGrasp]) -> tuple[str, ...]:
    """The arms in their order; one that has missed the object last: the other observes and reaches it differently."""
    missed = {one.arm for one in failed if one.code is Code.GRASP_MISSED}
    return tuple(sorted(arms, key=lambda arm: arm in missed))


def most_like(candidate: GraspCandidate, offered: Sequence[GraspCandidate]) -> GraspCandidate:
    """The one whose hand is turned most like a candidate's; of several, the nearest to its height."""

    def differs(other: GraspCandidate) -> tuple[float, float]:
        T, T_other = candidate.T_base_tcp, other.T_base_tcp
        return round(se3.angle_between(T_other[:3, :3], T[:3, :3]), 6), abs(float(T_other[2, 3] - T[2, 3]))

    return min(offered, key=differs)


def _offset(candidate: GraspCandidate, target: Detection) -> Array:
    return candidate.T_base_tcp[:3, 3] - target.foot


def _angle(a: Array, b: Array) -> float:
    return acos(float(np.clip(a @ b, -1.0, 1.0)))
