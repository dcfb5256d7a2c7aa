# SPDX-License-Identifier: Apache-2.0
"""Which arm reaches for an object, and the sentence for one that no arm can reach."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import arm_fault

#: By (x, y) of the first joint of each arm, base frame, m.
Shoulders = Mapping[str, Sequence[float]]


def check_arm(arm: str, arms: Collection[str]) -> None:
    """Refuse an arm that the robot does not have; see `arm_fault`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the arms.
    """
    if text := arm_fault(arm, arms):
        raise OpenArmError(Code.INVALID_ARGUMENT, text)


def arm_order(arm: str, y: float, overlap_half_width: float, shoulders: Shoulders) -> tuple[str, ...]:
    """Arms to try, in order.

    Args:
        arm: Which, or "auto" (also ""): that whose shoulder is nearest to the object's y, then those that the object is
            midway to.
        y: Position of the object along y, base frame, m.
        overlap_half_width: Distance from the middle of two arms up to which both are tried, m.
        shoulders: Shoulders of the arms.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another arm.
    """
    check_arm(arm, shoulders)
    if arm in shoulders:
        return (arm,)
    near, *others = sorted(shoulders, key=lambda name: abs(shoulders[name][1] - y))
    far = [o for o in others if abs(y - 0.5 * (shoulders[near][1] + shoulders[o][1])) <= overlap_half_width]
    return (near, *far)


def sides(arm: str, shoulders: Shoulders) -> tuple[float, ...]:
    """Signs of y on an arm's side of the table: both, when no other arm stands on one."""
    y = shoulders[arm][1]
    others = [other[1] for name, other in shoulders.items() if name != arm]
    return (1.0, -1.0) if not others else (1.0,) if y >= sum(others) / len(others) else (-1.0,)


def out_of_reach(what: str, distances: Mapping[str, float]) -> str:
    """Sentence about an object that cannot be reached.

    Args:
        what: The object or place with its position.
        distances: For each arm that was asked, how far its TCP stays away at the nearest, m; about 0 means that the
            position is reached, but not with the hand upright enough to grasp.
    """
    if not distances:
        return f"{what} is out of reach"
    parts = [
        f"the {arm} arm gets within {distance * 1e3:.0f} mm of it"
        if distance > 0.005
        else f"the {arm} arm reaches the point, but with no orientation that grasps"
        for arm, distance in sorted(distances.items(), key=lambda item: item[1])
    ]
    return f"{what} is out of reach: " + "; ".join(parts)
