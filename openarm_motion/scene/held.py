# SPDX-License-Identifier: Apache-2.0
"""What each arm holds, as far as plans say so: a plan says what is held on each of its parts, and where it touches."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import Box
from openarm_motion.timing.trajectory import Motion, Trajectory

#: Plans that are remembered; a caller executes what it planned last.
_PLANS = 32


@dataclass(frozen=True, eq=False)
class PlannedPart:
    """What a plan says of one of its parts: what the arm holds on it, and whether it touches something at its end."""

    held: tuple[Box, ...]
    touches: bool


class HeldObjects:
    """What the hands hold, and what they will hold when a plan is executed."""

    def __init__(self) -> None:
        self._held: dict[str, tuple[Box, ...]] = {}
        self._expected: OrderedDict[tuple[str, bytes], PlannedPart] = OrderedDict()

    @property
    def held(self) -> Mapping[str, tuple[Box, ...]]:
        """Boxes in the tool frame by arm; arms that hold nothing are left out."""
        return MappingProxyType({arm: boxes for arm, boxes in self._held.items() if boxes})

    def on_request(self, arm: str, attached: Sequence[Box], hand_empty: bool) -> tuple[tuple[Box, ...], str]:
        """What an arm holds on a motion that is asked for, and what the answer says of it.

        Args:
            arm: The arm.
            attached: Boxes that the request says it holds; nothing said is what it is known to hold.
            hand_empty: The request says that it holds nothing.

        Raises:
            OpenArmError: INVALID_ARGUMENT, when the request says both.
        """
        if attached and hand_empty:
            ids = ", ".join(box.id for box in attached)
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"attached names {ids}, and hand_empty is true; expected one of them"
            )
        known = self._held.get(arm, ())
        if attached or hand_empty or not known:
            return tuple(attached), ""
        ids = ", ".join(box.id for box in known)
        return known, f", with {ids} in the hand as before (hand_empty: true if it holds nothing any more)"

    def hold(self, arm: str, boxes: Sequence[Box]) -> bool:
        """Set what an arm holds; whether that is a change."""
        before, self._held[arm] = self._held.get(arm, ()), tuple(boxes)
        return not _same(before, self._held[arm])

    def expect(self, arm: str, trajectory: Trajectory, boxes: Sequence[Box], *, touches: bool = False) -> None:
        """Note what the arm will hold when it executes a trajectory, and whether it touches something at its end."""
        self._expected[arm, _key(trajectory.q)] = PlannedPart(tuple(boxes), touches)
        while len(self._expected) > _PLANS:
            self._expected.popitem(last=False)

    def expected(self, arm: str, motion: Motion) -> PlannedPart | None:
        """What was planned of a motion; None for one that was not planned here."""
        return self._expected.get((arm, _key(motion.q)))


def _key(q: NDArray[np.float64]) -> bytes:
    """A trajectory is known by where it starts and ends and by its number of samples; + 0.0 turns -0.0 into 0.0."""
    return (np.round(np.concatenate([q[0], q[-1], [float(len(q))]]), 6) + 0.0).tobytes()


def _same(a: Sequence[Box], b: Sequence[Box]) -> bool:
    return len(a) == len(b) and all(
        x.id == y.id and np.allclose(x.T, y.T) and np.allclose(x.size, y.size) for x, y in zip(a, b, strict=True)
    )
