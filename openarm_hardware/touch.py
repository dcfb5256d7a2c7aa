# SPDX-License-Identifier: Apache-2.0
"""Commands that would let the robot touch itself are refused, before a motor hears of them."""

from __future__ import annotations

import numpy as np

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.types import Array

#: Distance below which a command is refused, m. Planned motions keep 3 mm and more.
KEEP = 0.001
#: By so much an encoder's noise moves links, m.
_LESS = 0.0005
#: For so long arms are taken to move on as they do, s: two commands.
_AHEAD_S = 0.02


class TouchGuard:
    """Checks commands by the shapes that plans are checked by.

    Links that are nearer than `KEEP` when arms begin to follow, as when one leans on the other, may part.

    Args:
        checks: Checks of the robot, in the order of the joints of commands.
    """

    def __init__(self, checks: SelfCollision) -> None:
        self._checks = checks
        #: What each pair must keep now; None before the first command.
        self._keep: Array | None = None

    def begin(self) -> None:
        """Begin with the posture of the next command."""
        self._keep = None

    def refused(self, command: Array, position: Array, velocity: Array) -> str:
        """Return why the robot would touch itself, else nothing.

        Args:
            command: (n,) positions that are commanded.
            position: (n,) where the joints are.
            velocity: (n,) how they move.
        """
        keep = np.minimum(self._checks.distances(position), KEEP) - _LESS
        self._keep = keep = keep if self._keep is None else np.maximum(keep, self._keep)
        return self._nearer(command, keep, "is commanded") or self._nearer(
            position + _AHEAD_S * velocity, keep - KEEP, "moves"
        )

    def _nearer(self, posture: Array, keep: Array, what: str) -> str:
        distances = self._checks.distances(posture)
        if not (near := distances < keep).any():
            return ""
        nearest = self._checks.nearest(np.where(near, distances, np.inf))
        far = f"within {nearest.distance * 1e3:.1f} mm of" if nearest.distance > 0.0 else "to touch"
        return f"{nearest.first} {what} {far} {nearest.second}"
