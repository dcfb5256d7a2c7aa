# SPDX-License-Identifier: Apache-2.0
"""What the planner of approaches is asked, and why it did not choose a target. Base frame, m, rad."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.collision import Box, Contact
from openarm_motion.planning.failure import PlanFailedError, Stage


@dataclass(frozen=True, eq=False)
class Target:
    """One way to reach a place with the tool: lines from `pose` + `approach_offset` to `pose` to `retreat_offset`.

    Attributes:
        id: Returned in refusals.
        pose: (4, 4) of the tool.
        approach_offset: (3,) base frame.
        retreat_offset: (3,) base frame.
        score: A higher one is preferred.
    """

    id: str
    pose: Array
    approach_offset: Array
    retreat_offset: Array
    score: float = 0.0


@dataclass(frozen=True, eq=False)
class ApproachRequest:
    """What `plan_approach` is asked.

    Attributes:
        targets: Any of them will do.
        obstacles: Boxes beside the robot and the table, base frame.
        attached: Boxes held by the arm, tool frame.
        touchable: Ids of obstacles that the fingers may touch on the straight parts.
        attached_after: The touchable obstacles are carried on the retreat (a grasp).
        detached_after: The held boxes are left behind on the retreat (a place).
    """

    targets: tuple[Target, ...]
    obstacles: tuple[Box, ...] = ()
    attached: tuple[Box, ...] = ()
    touchable: frozenset[str] = frozenset()
    attached_after: bool = False
    detached_after: bool = False

    def check(self) -> None:
        """Refuse a request that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, without targets, for an unknown touchable id or numbers that are not finite.
        """
        if not self.targets:
            raise OpenArmError(Code.INVALID_ARGUMENT, "no targets, expected at least one")
        known = {box.id for box in self.obstacles}
        unknown = sorted(self.touchable - known)
        if unknown:
            there = ", ".join(sorted(known)) or "none"
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"touchable {', '.join(unknown)} not among the obstacles: {there}"
            )
        if self.attached_after and self.detached_after:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, "attached_after_approach and detached_after_approach exclude each other"
            )
        for target in self.targets:
            numbers = np.concatenate(
                [target.pose.ravel(), target.approach_offset, target.retreat_offset, [target.score]]
            )
            if not np.all(np.isfinite(numbers)):
                raise OpenArmError(Code.INVALID_ARGUMENT, f"target {target.id!r} has numbers that are not finite")

    def by_score(self, step: float) -> Iterator[list[int]]:
        """Indices of targets whose scores are within `step` of the best of their group, best group first."""
        order = sorted(range(len(self.targets)), key=lambda i: -self.targets[i].score)
        while order:
            least = self.targets[order[0]].score - step
            group = [i for i in order if self.targets[i].score >= least]
            yield group
            order = order[len(group) :]


@dataclass(frozen=True)
class Refused:
    """Why a target was not chosen: at which stage, and the pair in the way where there is one."""

    id: str
    code: Code
    message: str
    stage: Stage = "goal"
    contact: Contact | None = None

    @classmethod
    def of(cls, id: str, error: OpenArmError, message: str, stage: Stage = "goal") -> Refused:
        """For an error; `stage` is of one that does not know it."""
        if isinstance(error, PlanFailedError):
            return cls(id, error.code, message, error.stage, error.contact)
        return cls(id, error.code, message, stage)
