# SPDX-License-Identifier: Apache-2.0
"""Bodies of several shapes in the planning scene and in the hands: put, moved, attached and detached, all or nothing.

The scene and the hands know shapes alone; those of one body have names that `exact.part_name` makes of its own. What a
body has more than that is kept here: the frame that it is moved by, and its true shapes while a hand holds it (plans
carry the box about each). Base frame, m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.exact import body_of, part_name
from openarm_motion.collision.solids import Box, Solid

if TYPE_CHECKING:
    from openarm_motion.service.motion_service import MotionService


@dataclass(frozen=True, eq=False)
class SceneBody:
    """A body: its own frame `T` (4, 4), and shapes in the frame that `T` is in."""

    id: str
    T: Array
    shapes: tuple[Solid, ...]

    def moved(self, by: Array) -> SceneBody:
        """The body in another frame, or elsewhere: all poses times `by` (4, 4)."""
        return SceneBody(self.id, by @ self.T, tuple(replace(shape, T=by @ shape.T) for shape in self.shapes))

    def named(self) -> SceneBody:
        """The body with the names of its shapes that the scene knows it by."""
        many = len(self.shapes) > 1
        names = [part_name(self.id, k) if many else self.id for k in range(len(self.shapes))]
        shapes = tuple(replace(shape, id=name) for shape, name in zip(self.shapes, names, strict=True))
        return SceneBody(self.id, self.T, shapes)


@dataclass(frozen=True, eq=False)
class HeldBody:
    """A body that an arm's hand holds, in the frame of the tool."""

    arm: str
    body: SceneBody


@dataclass(eq=False)
class SceneDraft:
    """A change of the scene, and of what hands hold, before it is in force."""

    world: dict[str, SceneBody]
    held: dict[str, HeldBody]
    allowed: frozenset[frozenset[str]]
    changed: set[str] = field(default_factory=set[str])

    def put(self, body: SceneBody, *, append: bool = False) -> None:
        """Add a body, replace it, or append shapes to it."""
        if append and body.id in self.world:
            there = self.world[body.id]
            body = SceneBody(body.id, there.T, (*there.shapes, *body.shapes))
        self.world[body.id] = body
        self.changed.add(body.id)

    def move(self, id: str, T: Array) -> None:
        """Move a body to where its own frame is at `T` (4, 4)."""
        there = self._there(id)
        self.world[id] = there.moved(T @ se3.inverse(there.T))
        self.changed.add(id)

    def remove(self, id: str) -> None:
        """Remove a body; "" removes all."""
        if not id:
            self.world.clear()
            return
        self._there(id)
        del self.world[id]

    def attach(self, id: str, arm: str, T_base_tool: Array, shapes: SceneBody | None) -> None:
        """Let a hand hold a body of the scene, or one that is given, base frame."""
        body = shapes if shapes is not None else self._there(id)
        self.world.pop(id, None)
        self.held[id] = HeldBody(arm, body.moved(se3.inverse(T_base_tool)))

    def detach(self, id: str, T_base_tool: Array) -> None:
        """Put a body that a hand holds where it is now."""
        if id not in self.held:
            raise _unknown(id, self.held, "in a hand")
        self.put(self.held.pop(id).body.moved(T_base_tool))

    def _there(self, id: str) -> SceneBody:
        if id not in self.world:
            raise _unknown(id, self.world, "in the scene")
        return self.world[id]


class SceneBodies:
    """The bodies of a motion service.

    Args:
        service: Owns scene and hands.
    """

    def __init__(self, service: MotionService) -> None:
        self._service = service
        self._frames: dict[str, Array] = {}
        self._held: dict[str, HeldBody] = {}

    @property
    def world(self) -> dict[str, SceneBody]:
        """Bodies of the scene but for the fixed ones."""
        parts: dict[str, list[Solid]] = {}
        for solid in self._service.scene.solids:
            parts.setdefault(body_of(solid.id), []).append(solid)
        return {id: SceneBody(id, self._frames.get(id, solids[0].T), tuple(solids)) for id, solids in parts.items()}

    @property
    def held(self) -> dict[str, HeldBody]:
        """What the hands hold; of what was not attached here, the boxes that plans carry."""
        out: dict[str, HeldBody] = {}
        for arm, boxes in self._service.memory.held.items():
            for box in boxes:
                id = body_of(box.id)
                mine = self._held.get(id)
                if mine is not None and mine.arm == arm:
                    out[id] = mine
                else:
                    known = out[id].body.shapes if id in out else ()
                    out[id] = HeldBody(arm, SceneBody(id, box.T, (*known, box)))
        return out

    def draft(self) -> SceneDraft:
        """A change that begins with what is."""
        return SceneDraft(self.world, self.held, self._service.scene.allowed)

    def apply(self, draft: SceneDraft) -> None:
        """Put a change in force.

        Raises:
            OpenArmError: as `PlanningScene.apply`; nothing has changed then.
        """
        before = self.world
        add: list[Solid] = []
        remove = [
            s.id for id, body in before.items() if id not in draft.world or id in draft.changed for s in body.shapes
        ]
        for id in draft.changed & set(draft.world):
            add += draft.world[id].named().shapes
        if remove or add:
            self._service.apply_scene(clear=False, remove=remove, add=add)
        self._service.scene.allow(draft.allowed)
        self._frames = {id: body.T for id, body in draft.world.items()}
        self._held = dict(draft.held)
        for arm in self._service.arms:
            boxes = [box for held in draft.held.values() if held.arm == arm for box in boxes_about(held.body)]
            self._service.coordination.hold(arm, boxes)


def boxes_about(body: SceneBody) -> list[Box]:
    """The box about each shape."""
    out: list[Box] = []
    for shape in body.named().shapes:
        T = shape.T @ se3.make(None, shape.centre)
        out.append(Box(shape.id, T, np.asarray(shape.extents)))
    return out


def _unknown(id: str, there: Sequence[str] | dict[str, SceneBody] | dict[str, HeldBody], where: str) -> OpenArmError:
    names = ", ".join(there) or "none"
    return OpenArmError(Code.UNKNOWN_OBJECT, f"object {id!r} is not {where}; objects {where}: {names}")
