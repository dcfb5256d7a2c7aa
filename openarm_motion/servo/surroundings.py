# SPDX-License-Identifier: Apache-2.0
"""Whether courses of the arms keep clear: the planning scene, the map, the robot itself, as they were when it was made.

Not for two threads at once. Configurations are those of all arms, one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance, Contact
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.line_checks import LineChecks
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import DualArm

#: What is too near already may come nearer by this on a course, by rounding, m.
_SLACK = 1e-4


#: Pairs that are too near, and their distances, m.
Near = dict[tuple[str, str], float]


def _pair(contact: Contact) -> tuple[str, str]:
    return contact.first, contact.second


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is around the arms.

    Attributes:
        names: The arms, in the order of configurations.
        exact: The exact layer.
        fast: The fast layer, of the same distances.
    """

    names: tuple[str, ...]
    exact: LineChecks
    fast: FastScene
    _asked: ExitStack

    @classmethod
    def of(
        cls, arms: Sequence[Arm], now: StartState, held: Sequence[Sequence[Box]], clearance: Clearance, lag: float
    ) -> Surroundings:
        """Take what is around arms as it is in a state.

        Args:
            arms: One arm, or two.
            now: Joints, planning scene and map.
            held: Boxes that each arm holds, tool frame.
            clearance: Distances to keep.
            lag: Joints may be this far from their set points, rad; what that moves is kept in addition.
        """
        environment = now.environment
        if len(arms) == 2:
            both, parts = DualArm(*arms), (held[0], held[1])
            scene: LineChecks = both.scene(
                now.state, (), clearance.arms, held=parts, environment=environment, clearance=clearance
            )
        else:
            scene = arms[0].scene(now.state, (), held[0], environment=environment, clearance=clearance)
        asked = ExitStack()
        asked.enter_context(scene.further(lag * scene.swings().sum(axis=1)))
        found = cls(tuple(arm.name for arm in arms), scene, FastScene(scene.arms, scene.arms[0].distances), asked)
        here = np.array([[now.state[joint] for arm in arms for joint in arm.names]])
        # the first checks take longer, and while servoing nothing may
        found.free(here)
        found.near(here)
        return found

    def joined(self, parts: Mapping[str, Array]) -> Array:
        """Configurations (m, n) of all arms, of those (m, k) or (k,) of each."""
        rows = max(len(np.atleast_2d(part)) for part in parts.values())
        each = [np.broadcast_to(np.atleast_2d(parts[name]), (rows, parts[name].shape[-1])) for name in self.names]
        return np.hstack(each)

    def combined(self, name: str, path: Array, others: Mapping[str, Array]) -> Array:
        """Configurations (k, m, n) of all arms: one on its path (m, i), with each of up to k positions of the others.

        Args:
            name: The arm.
            path: Its positions.
            others: Positions (up to k, j) of each other arm; the last one stands for those that lack.
        """
        count, steps = max((len(rows) for rows in others.values()), default=1), len(path)
        parts = [
            np.tile(path, (count, 1))
            if one == name
            else np.repeat(others[one][np.minimum(np.arange(count), len(others[one]) - 1)], steps, axis=0)
            for one in self.names
        ]
        return np.hstack(parts).reshape(count, steps, -1)

    def free(self, states: Array) -> bool:
        """Whether configurations (m, n) are proven free; between two of a course lies less than the clearance."""
        return bool(self.fast.free_many(states).all())

    def near(self, states: Array) -> list[Near]:
        """What is too near at configurations (m, n): by pair, its distance, m. An exact check takes 0.8 ms."""
        return [{_pair(contact): contact.distance for contact in self.exact.contacts(q)} for q in states]

    def no_nearer(self, states: Array, before: Near) -> bool:
        """Whether at configurations (m, n) nothing is nearer than it may be, or than it was before."""
        return not any(
            contact.distance < before.get(_pair(contact), np.inf) - _SLACK
            for q in states
            for contact in self.exact.contacts(q)
        )

    def contact(self, path: Array) -> Contact | None:
        """The first pair on configurations (m, n) that is too near."""
        return next((contacts[0] for q in path if (contacts := self.exact.contacts(q))), None)
