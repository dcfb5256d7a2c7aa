# SPDX-License-Identifier: Apache-2.0
"""Answers of the client. Base frame, m, rad."""

from __future__ import annotations

from dataclasses import dataclass

from openarm_common.errors import Answer
from openarm_grasp.planning.options import Option


@dataclass(frozen=True)
class GraspResult(Answer):
    """How a grasp ended.

    Success: the object was placed and seen there (dry run: it could be).

    Attributes:
        outcome: SUCCESS; PARTIAL: held, not placed as asked; FAILED; REFUSED: never touched; CANCELLED.
        label: What was picked.
        arm: The arm that was used, or "".
        attempts: Physical attempts.
        place_position: (x, y, z) of the target on the table, base frame, m.
        duration: s of robot time.
        route: "direct"; "hand_over": by way of the middle, with both arms; "push": pushed into reach; "" when it was
            not placed.
        options: Ways to grasp that were weighed for the newest plan, by arm, the preferred first; of one object only.
    """

    outcome: str
    label: str
    arm: str
    attempts: int
    place_position: tuple[float, float, float]
    duration: float
    route: str = ""
    options: tuple[Option, ...] = ()


@dataclass(frozen=True)
class PairResult(Answer):
    """How two grasps that were asked for at once ended.

    Success: of both; else the code is that of the first that failed.

    Attributes:
        outcome: SUCCESS; PARTIAL: one of them, or picked and not placed as asked; FAILED; REFUSED: none was touched;
            CANCELLED.
        simultaneous: Both arms moved at the same time.
        results: Of each, in the order asked; none when they were not taken.
        duration: s of robot time.
    """

    outcome: str
    simultaneous: bool
    results: tuple[GraspResult, ...]
    duration: float
