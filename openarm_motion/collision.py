# SPDX-License-Identifier: Apache-2.0
"""Exact collision checks of one arm: against itself, the rest of the robot, boxes around it, and what it holds.

The robot's shapes come from the URDF, the pairs that may touch from the SRDF; pinocchio and coal do the geometry behind
a broad phase. Every pair has a distance that it must keep: the checks answer "nearer than that?" Boxes are in the base
frame (the description's root), held boxes in the frame of the tool centre point. m, rad.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision_robot import CollisionRobot

Array = NDArray[np.float64]

#: Two shapes further apart than this in a report are not worth a number.
_REPORT_RANGE = 1.0


@dataclass(frozen=True, eq=False)
class Box:
    """An oriented box: `T` (4, 4) of its centre, `size` (3,) full edges, m."""

    id: str
    T: Array
    size: Array

    def __post_init__(self) -> None:
        """Refuse a box that is none.

        Raises:
            OpenArmError: INVALID_ARGUMENT, naming the box and its size.
        """
        if self.size.shape != (3,) or not np.all(np.isfinite(self.size)) or not np.all(self.size > 0.0):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"box {self.id!r} has size {self.size.tolist()}, expected three edges > 0 m"
            )


class Clearance(Config):
    """Distances that pairs keep, m; nearer is a collision."""

    own: float = Field(
        default=0.003, ge=0.0, le=0.05, description="between links of the arm, and to the robot's body, m"
    )
    world: float = Field(default=0.010, ge=0.0, le=0.1, description="arm to boxes, m")
    arms: float = Field(default=0.010, ge=0.0, le=0.1, description="arm to the other arm, m")
    hand: float = Field(default=0.010, ge=0.0, le=0.1, description="hand, or what it holds, to boxes, m")
    touch: float = Field(
        default=0.002, ge=0.0, le=0.05, description="arm and palm to a box that the fingers may touch, m"
    )
    rest: float = Field(
        default=0.0, ge=-0.02, le=0.05, description="held box to what it stands on; < 0 allows overlap, m"
    )


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What is around an arm in one query.

    Attributes:
        state: Positions of (at least) the robot's other movable joints; missing ones are taken as 0.
        boxes: Obstacles, base frame.
        held: Boxes held by this arm, pose in the tool frame.
        touchable: Ids of boxes that the fingers may touch.
        supports: Ids of boxes that a held box may stand on.
        fixed: Ids of boxes that are where they are said to be; the others are estimates.
        clearance: Distances to keep.
        own: Whether the arm is checked against itself and the robot's body; False leaves the other arm and the boxes.
    """

    state: Mapping[str, float]
    boxes: Sequence[Box] = ()
    held: Sequence[Box] = ()
    touchable: frozenset[str] = frozenset()
    supports: frozenset[str] = frozenset()
    fixed: frozenset[str] = frozenset()
    clearance: Clearance = field(default_factory=Clearance)
    own: bool = True


@dataclass(frozen=True)
class Contact:
    """Two things nearer to each other than allowed; `distance` < 0 is how deep they overlap, m."""

    first: str
    second: str
    distance: float
    required: float

    def __str__(self) -> str:
        """Sentence for a refusal."""
        if self.distance <= 0.0:
            return f"{self.first} would hit {self.second} ({-self.distance * 1e3:.0f} mm deep)"
        return (
            f"{self.first} would come within {self.distance * 1e3:.1f} mm of {self.second},"
            f" expected {self.required * 1e3:.0f} mm"
        )


class CollisionScene:
    """One arm in one set of surroundings. Not for two threads at once; build one for each query (4 ms).

    Args:
        robot: The robot seen by the arm.
        around: What is around it.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when two boxes have one id.
    """

    def __init__(self, robot: CollisionRobot, around: Surroundings) -> None:
        self._robot = robot
        self._around = around
        self._geometry = robot.geometry.copy()
        self._names = [*robot.links]
        self._boxes: dict[str, int] = {}
        self._q = robot.configuration(around.state)
        self.levers = robot.levers
        pairs, required = self._pairs()
        for i, j in pairs:
            self._geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._pair_index = pairs
        self._required = np.array(required)
        self._data = robot.model.createData()
        self._geometry_data = pin.GeometryData(self._geometry)
        self._set_margins()

    @property
    def robot(self) -> CollisionRobot:
        """The robot as the arm sees it."""
        return self._robot

    @property
    def around(self) -> Surroundings:
        """What is around the arm."""
        return self._around

    def shapes(self) -> list[tuple[int, Array, coal.ShapeBase]]:
        """Joint, pose (4, 4) in that joint's frame, and geometry of every shape; the robot's come first."""
        return [(o.parentJoint, np.array(o.placement.homogeneous), o.geometry) for o in self._geometry.geometryObjects]

    def joint_poses(self) -> list[Array]:
        """Poses (4, 4) of the model's joints with the arm wherever it was last put."""
        pin.forwardKinematics(self._robot.model, self._data, self._q)
        return [np.array(pose.homogeneous) for pose in self._data.oMi]

    def required(self) -> list[tuple[int, int, float]]:
        """Pairs of shapes and the distance that each must keep, m."""
        return [(i, j, float(d)) for (i, j), d in zip(self._pair_index, self._required, strict=True)]

    def collides(self, q: ArrayLike) -> bool:
        """Whether some pair is nearer than it may be at the arm's configuration (n,)."""
        self._robot.put(self._q, q)
        return bool(pin.computeCollisions(self._robot.model, self._data, self._manager, self._q, True))

    def contacts(self, q: ArrayLike) -> list[Contact]:
        """All pairs that are nearer than they may be, the deepest first."""
        found = [self._contact(k) for k in self._colliding(q)]
        return sorted(found, key=lambda contact: contact.distance - contact.required)

    def edge_free(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.04) -> bool:
        """Whether the straight joint line between two configurations is free, the ends included.

        Args:
            a: (n,) rad.
            b: (n,) rad.
            step: No joint turns further than this between two checks, rad.
            travel: No point of the arm moves further than this between two checks, m.
        """
        return self.first_hit(a, b, step, travel) is None

    def first_hit(self, a: Array, b: Array, step: float = 0.05, travel: float = 0.04) -> Array | None:
        """Some colliding configuration on the line between two, or None; far-apart points are looked at first."""
        difference = b - a
        size = np.abs(difference)
        n = int(np.ceil(max(float(size.max()) / step, float(size @ self.levers) / travel, 1.0)))
        for u in spread(n):
            q = a + u * difference
            if self.collides(q):
                return q
        return None

    def relax(self, q: ArrayLike, allowance: float, estimates: float | None = None) -> Contact | None:
        """Let pairs that are too near at `q` stay as near as they are: an arm must be able to leave where it is.

        Args:
            q: (n,) where a motion starts.
            allowance: Overlap that is taken for an error of measurement, m.
            estimates: The same for pairs with boxes that are only estimated (all but `fixed`), m.

        Returns:
            A pair that overlaps deeper than that (nothing is relaxed then), or None.
        """
        colliding = self._colliding(q)
        contacts = [self._contact(k) for k in colliding]
        guessed = {box.id for box in self._around.boxes} - self._around.fixed
        for contact in contacts:
            limit = allowance if estimates is None or contact.second not in guessed else estimates
            if contact.distance < -limit:
                return contact
        for k, contact in zip(colliding, contacts, strict=True):
            self._required[k] = contact.distance - 1e-3
        if colliding:
            self._set_margins()
        return None

    @contextmanager
    def lenient(self, share: float) -> Iterator[None]:
        """Ask for only a share of each positive distance meanwhile."""
        asked = self._required
        self._required = np.where(asked > 0.0, share * asked, asked)
        self._set_margins()
        try:
            yield
        finally:
            self._required = asked
            self._set_margins()

    def place(self, id: str, T: Array) -> None:
        """Move a box: `T` in the base frame, or in the tool frame for a held one."""
        held = self._held_name(id) in self._boxes
        index = self._boxes[self._held_name(id) if held else id]
        self._geometry.geometryObjects[index].placement = pin.SE3(self._robot.kinematics.tip @ T if held else T)

    def set_state(self, state: Mapping[str, float]) -> None:
        """Move the robot's other joints."""
        self._q = self._robot.configuration(state)

    def gap(self, q: ArrayLike, links: frozenset[str]) -> float:
        """Smallest distance between what moves and some links, m (< 0: overlap); infinite where no pair is checked."""
        self._robot.put(self._q, q)
        pin.updateGeometryPlacements(self._robot.model, self._data, self._geometry, self._geometry_data, self._q)
        pairs = [k for k, (_, j) in enumerate(self._pair_index) if self._names[j] in links]
        return min((self._contact(k).distance for k in pairs), default=float("inf"))

    def put_other(self, other: CollisionScene, q: ArrayLike) -> None:
        """Move the arm of another scene of the same robot to its configuration (n,)."""
        other._robot.put(self._q, q)

    def _colliding(self, q: ArrayLike) -> list[int]:
        self._robot.put(self._q, q)
        pin.computeCollisions(self._robot.model, self._data, self._geometry, self._geometry_data, self._q, False)
        results = self._geometry_data.collisionResults
        return [k for k in range(len(self._pair_index)) if results[k].isCollision()]

    def _contact(self, k: int) -> Contact:
        result = pin.computeDistance(self._geometry, self._geometry_data, k)
        i, j = self._pair_index[k]
        distance = min(float(result.min_distance), _REPORT_RANGE)
        return Contact(self._names[i], self._names[j], distance, float(self._required[k]))

    def _set_margins(self) -> None:
        for request, margin in zip(self._geometry_data.collisionRequests, self._required.tolist(), strict=True):
            request.security_margin = margin
        self._manager = pin.BroadPhaseManager_NaiveCollisionManager(
            self._robot.model, self._geometry, self._geometry_data
        )

    def _pairs(self) -> tuple[list[tuple[int, int]], list[float]]:
        """Add the boxes to the geometry; all pairs to check and the distance that each must keep."""
        robot, around, keep = self._robot, self._around, self._around.clearance
        own = robot.arm.fixed | robot.arm.moving
        pairs = [pair for pair in robot.pairs if around.own or robot.links[pair[1]] not in own]
        required = [keep.own if robot.links[j] in own else keep.arms for _, j in pairs]
        tool = robot.joints[-1]
        held = [self._add(self._held_name(box.id), tool, robot.kinematics.tip @ box.T, box) for box in around.held]
        for h in held:
            self.levers = np.maximum(self.levers, robot.levers_of(self._geometry.geometryObjects[h]))
            for i, link in enumerate(robot.links):
                if link not in robot.arm.hand and (around.own or link not in own):
                    pairs.append((h, i))
                    required.append(
                        keep.own if link in robot.arm.moving else keep.arms if link not in own else keep.world
                    )
        for box in around.boxes:
            b = self._add(box.id, 0, box.T, box)
            touchable = box.id in around.touchable
            for i in robot.moving:
                link = robot.links[i]
                if touchable and link in robot.arm.gripper:
                    continue
                pairs.append((i, b))
                required.append(keep.touch if touchable else keep.hand if link in robot.arm.hand else keep.world)
            for h in held:
                pairs.append((h, b))
                required.append(keep.rest if box.id in around.supports else keep.hand)
        return pairs, required

    @staticmethod
    def _held_name(id: str) -> str:
        return f"held {id}"

    def _add(self, name: str, joint: int, T: Array, box: Box) -> int:
        if name in self._boxes:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"two boxes have the id {box.id!r}; ids must be unique")
        shape = pin.GeometryObject(name, joint, pin.SE3(T), coal.Box(*box.size.tolist()))
        self._names.append(name)
        self._boxes[name] = int(self._geometry.addGeometryObject(shape))
        return self._boxes[name]


def box_from(id: str, p: ArrayLike, size: ArrayLike, R: Array | None = None) -> Box:
    """Box of its centre (3,), full edges (3,) and rotation (3, 3)."""
    T = np.eye(4)
    T[:3, 3] = p
    if R is not None:
        T[:3, :3] = R
    return Box(id, T, np.asarray(size, dtype=np.float64))


@lru_cache(maxsize=512)
def spread(n: int) -> tuple[float, ...]:
    """0, 1/n, ..., 1 with the ends and far-apart points first, so that a collision is found early."""
    order: list[int] = [n, 0]
    gap = n
    seen = {0, n}
    while len(seen) <= n:
        gap = max(gap // 2, 1)
        for k in range(gap, n, gap):
            if k not in seen:
                seen.add(k)
                order.append(k)
    return tuple(k / n for k in order)
