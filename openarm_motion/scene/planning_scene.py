# SPDX-License-Identifier: Apache-2.0
"""The bodies that every plan keeps clear of, in versions: a plan says which one it was made in. Base frame, m."""

from __future__ import annotations

from collections.abc import Sequence

from openarm_common.errors import Code
from openarm_motion.collision.occupancy import MAP
from openarm_motion.collision.solids import Box, Solid
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.scene.octree import SceneOctree


class PlanningScene:
    """The one scene of the motion node. Its version is 1 at first, and counts up with every change.

    Args:
        fixed: Bodies that can't be changed: the table.
    """

    def __init__(self, fixed: Sequence[Box] = ()) -> None:
        self.fixed: tuple[Box, ...] = tuple(fixed)
        self.version = 1
        self._solids: dict[str, Solid] = {}
        #: Pairs of links and bodies that may touch, in addition to those of the SRDF.
        self.allowed: frozenset[frozenset[str]] = frozenset()
        #: What is occupied in addition to the bodies and the map.
        self.octree: SceneOctree | None = None

    def allow(self, pairs: frozenset[frozenset[str]]) -> None:
        """Let these pairs of links and bodies touch, by name, and no others but those of the SRDF."""
        if pairs != self.allowed:
            self.allowed = pairs
            self.version += 1

    def see(self, octree: SceneOctree | None) -> None:
        """Take an octree in place of the one there was; None takes it away."""
        if octree is not self.octree:
            self.octree = octree
            self.version += 1

    @property
    def solids(self) -> tuple[Solid, ...]:
        """Bodies in addition to the fixed ones, in the order in which they came."""
        return tuple(self._solids.values())

    def fix(self, fixed: Sequence[Box]) -> None:
        """Take other bodies that can't be changed: the table is elsewhere."""
        self.fixed = tuple(fixed)
        self.version += 1

    def apply(self, *, clear: bool, remove: Sequence[str], add: Sequence[Solid], expected: int = 0) -> int:
        """Change the bodies, all as asked or nothing.

        Args:
            clear: First remove all.
            remove: Ids.
            add: Bodies that are new, or replace those of their ids.
            expected: Refused unless the scene has this version; 0 is any.

        Returns:
            The version after it.

        Raises:
            PlanFailedError: STALE_DATA, for another version; INVALID_ARGUMENT, naming the id that is unknown, fixed,
                empty or used twice.
        """
        self.require(expected)
        there = {} if clear else dict(self._solids)
        for id in remove:
            if id not in there:
                known = ", ".join(there) or "none"
                raise _invalid(f"can't remove {id!r}: it is not in the scene; bodies: {known}")
            del there[id]
        reserved = {MAP, *(box.id for box in self.fixed)}
        for k, solid in enumerate(add):
            if not solid.id or solid.id in reserved:
                what = f"the id {solid.id!r} belongs to what can't be changed" if solid.id else f"body {k} has no id"
                raise _invalid(f"{what}; expected an id of its own")
            if any(solid.id == other.id for other in add[:k]):
                raise _invalid(f"two bodies of the request have the id {solid.id!r}; ids must be unique")
            there[solid.id] = solid
        if clear or remove or add:
            self._solids = there
            self.version += 1
        return self.version

    def require(self, expected: int) -> None:
        """Refuse what was made for another version of the scene; 0 is any.

        Raises:
            PlanFailedError: STALE_DATA, with both versions.
        """
        if expected not in (0, self.version):
            text = f"the planning scene has version {self.version}, expected {expected}: it was changed; plan again"
            raise PlanFailedError(Code.STALE_DATA, text, "scene")


def _invalid(text: str) -> PlanFailedError:
    return PlanFailedError(Code.INVALID_ARGUMENT, text, "scene")
