# SPDX-License-Identifier: Apache-2.0
"""Which arm reaches for an object, and the sentence for one that no arm can reach."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

from openarm_common.errors import Code, OpenArmError

#: The arms of the description, by side.
ARMS: tuple[Literal["left", "right"], ...] = ("left", "right")


def arm_order(arm: str, y: float, overlap_half_width: float) -> tuple[str, ...]:
    """Arms to try, in order.

    Args:
        arm: "left", "right", or "auto" (also ""): the arm on the object's side, and in the strip between both also
            the other.
        y: Of the object, base frame, m; the left arm stands at y > 0.
        overlap_half_width: |y| up to which both arms are tried, m.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another arm.
    """
    if arm in ARMS:
        return (arm,)
    if arm not in ("auto", ""):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"arm {arm!r} does not exist; valid: auto, {', '.join(ARMS)}")
    near, far = ("left", "right") if y >= 0.0 else ("right", "left")
    return (near, far) if abs(y) <= overlap_half_width else (near,)


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
