# SPDX-License-Identifier: Apache-2.0
"""Exact collision checks of one arm: against itself, the rest of the robot, boxes around it, and what it holds.

The robot's shapes come from the URDF, the pairs that may touch from the SRDF; pinocchio and coal do the geometry behind
a broad phase. Every pair has a distance that it must keep: the checks answer "nearer than that?" Boxes are in the base
frame (the description's root), held boxes in the frame of the tool centre point. m, rad.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.line_checks import LineChecks
from openarm_motion.collision.occupancy import MAP, DistanceMap, OccupancyMap
from openarm_motion.collision.robot import CollisionRobot
from openarm_motion.collision.solids import Box, Solid


class Clearance(Config):
    """Distances that pairs keep, m; nearer is a collision."""

    own: float = Field(
        default=0.003, ge=0.0, le=0.05, description="between links of the arm, and to the robot's body, m"
    )
    world: float = Field(default=0.010, ge=0.0, le=0.1, description="arm to boxes, m")
    arms: float = Field(default=0.030, ge=0.0, le=0.1, description="arm to the other arm, m")
    hand: float = Field(default=0.010, ge=0.0, le=0.1, description="hand, or what it holds, to boxes, m")
    touch: float = Field(
        default=0.002, ge=0.0, le=0.05, description="arm and palm to a box that the fingers may touch, m"
    )
    rest: float = Field(
        default=0.0, ge=-0.02, le=0.05, description="held box to what it rests on; < 0 allows overlap, m"
    )


@dataclass(frozen=True, eq=False)
class CollisionContext:
    """What is around an arm in one query.

    Attributes:
        state: Positions of (at least) the robot's other movable joints; missing ones are taken as 0.
        boxes: Obstacles, base frame; boxes or other bodies.
        held: Boxes held by this arm, pose in the tool frame.
        carried: Boxes that go with the other arm: the joint that each hangs on, pose in that joint's frame.
        touchable: Ids of boxes that the fingers may touch.
        supports: Ids of boxes that a held box may rest on.
        fixed: Ids of boxes that are where they are said to be; the others are estimates.
        clearance: Distances to keep.
        map: Map of the cameras; None is nothing.
        own: Whether the arm is checked against itself and the robot's body; False leaves the other arm and the boxes.
        allowed: Pairs of links and bodies that may touch, by name (see `body_of`).
    """

    state: Mapping[str, float]
    boxes: Sequence[Solid] = ()
    held: Sequence[Box] = ()
    carried: Sequence[tuple[int, Box]] = ()
    touchable: frozenset[str] = frozenset()
    supports: frozenset[str] = frozenset()
    fixed: frozenset[str] = frozenset()
    clearance: Clearance = field(default_factory=Clearance)
    map: OccupancyMap | None = None
    own: bool = True
    allowed: frozenset[frozenset[str]] = frozenset()


@dataclass(frozen=True)
class Contact:
    """Two bodies nearer to each other than allowed.

    Attributes:
        first: Link or held box.
        second: Link or obstacle.
        distance: < 0 is how deep they overlap, m.
        required: Clearance that is required, m.
        where: Added to the name of the second in a sentence.
    """

    first: str
    second: str
    distance: float
    required: float
    where: str = ""

    def __str__(self) -> str:
        """Sentence for a refusal."""
        second = self.second + self.where
        if self.distance <= 0.0:
            return f"{self.first} would hit {second} ({-self.distance * 1e3:.0f} mm deep)"
        return (
            f"{self.first} would come within {self.distance * 1e3:.1f} mm of {second},"
            f" expected {self.required * 1e3:.0f} mm"
        )


#: A pair that may stay as near as it is may come nearer by this, m.
_LESS = 1e-3
#: Less than what the design holds a pair apart is asked of it, m: that was found by samples.
_ROUNDED = 1e-4
#: Two shapes further apart than this in a report are not worth a number.
_REPORT_RANGE = 1.0
#: What pairs that may touch are asked to keep, m: they never overlap by so much.
_NOTHING_ASKED = -100.0
#: Before a held body's name, and between the name of a body and the number of its shape.
_HELD, _PART = "held ", " #"


def part_name(body: str, number: int) -> str:
    """Name of one of several shapes of a body."""
    return f"{body}{_PART}{number}"


def body_of(name: str) -> str:
    """Name of the link or body that a shape belongs to, in the hand or not."""
    return name.removeprefix(_HELD).partition(_PART)[0]


class CollisionScene(LineChecks):
    """One arm in one set of surroundings. Not for two threads at once; build one for each query (4 ms).

    Args:
        robot: The robot seen by the arm.
        around: Obstacles around it.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when two boxes have one id.
    """

    def __init__(self, robot: CollisionRobot, around: CollisionContext) -> None:
        self._robot = robot
        self._q = robot.configuration(around.state)
        self._build(around)

    def _build(self, around: CollisionContext) -> None:
        robot = self._robot
        self._around = around
        self._geometry, known = robot.checked(around.own)
        self._names = [*robot.links]
        self._boxes: dict[str, int] = {}
        self._solids: dict[str, Solid] = {}
        self._balls: dict[int, tuple[Array, float]] = {}
        self._towards: dict[frozenset[str], NDArray[np.int64]] = {}
        pairs, required = self._pairs(known)
        for i, j in pairs[len(known) :]:
            self._geometry.addCollisionPair(pin.CollisionPair(i, j))
        self._pair_index = pairs
        self._required = np.array(required)
        if around.allowed:
            bodies = [body_of(name) for name in self._names]
            may = [frozenset((bodies[i], bodies[j])) in around.allowed for i, j in pairs]
            self._required[may] = _NOTHING_ASKED
        self._measure()
        own, others = robot.arm.fixed | robot.arm.moving, {*robot.links, *self.carried}
        self._arms = np.array([self._names[j] in others and self._names[j] not in own for _, j in pairs])
        self._data = robot.model.createData()
        self._geometry_data = pin.GeometryData(self._geometry)
        self._set = False

    @property
    def arms(self) -> Sequence[CollisionScene]:
        """This scene alone."""
        return (self,)

    @property
    def robot(self) -> CollisionRobot:
        """The robot as the arm sees it."""
        return self._robot

    @property
    def around(self) -> CollisionContext:
        """What is around the arm."""
        return self._around

    def shapes(self) -> list[tuple[int, Array, Solid]]:
        """Joint, pose (4, 4) in that joint's frame, and body of every shape but the map; the robot's come first."""
        found: list[tuple[int, Array, Solid]] = []
        for k, o in enumerate(self._geometry.geometryObjects):
            if o.name == MAP:
                continue
            solid = self._robot.solids[k] if k < len(self._robot.solids) else self._solids[o.name]
            found.append((o.parentJoint, np.array(o.placement.homogeneous), solid))
        return found

    @property
    def carried(self) -> frozenset[str]:
        """Names of what goes with the other arm."""
        return frozenset(box.id for _, box in self._around.carried)

    def joint_poses(self) -> list[Array]:
        """Poses (4, 4) of the model's joints with the arm wherever it was last put."""
        pin.forwardKinematics(self._robot.model, self._data, self._q)
        return [np.array(pose.homogeneous) for pose in self._data.oMi]

    def required(self) -> list[tuple[int, int, float]]:
        """Pairs of shapes and the distance that each must keep, m; not those with the map, and those that may touch."""
        pairs = zip(self._pair_index, self._required, strict=True)
        asked = (((i, j), d) for (i, j), d in pairs if self._names[j] != MAP and d > _NOTHING_ASKED)
        return [(i, j, float(d)) for (i, j), d in asked]

    def map_clearance(self) -> dict[int, float]:
        """Distance that each shape keeps from a map, m, whether there is one or not."""
        out = self._from_map()
        for (i, j), keep in zip(self._pair_index, self._required, strict=True):
            if self._names[j] == MAP:
                out[i] = float(keep)
        return out

    @property
    def distances(self) -> DistanceMap | None:
        """The map for fast checks; None without one."""
        seen = self._around.map
        return None if seen is None or not len(seen.indices) else seen.distances

    def _from_map(self) -> dict[int, float]:
        keep, hand = self._around.clearance, self._robot.arm.hand
        out = {i: keep.hand if self._robot.links[i] in hand else keep.world for i in self._robot.moving}
        out |= {self._boxes[self._held_name(box.id)]: keep.hand for box in self._around.held}
        # exact checks with the map know no negative distance: what may touch it is left out
        return {i: d for i, d in out.items() if frozenset((body_of(self._names[i]), MAP)) not in self._around.allowed}

    def collides(self, q: ArrayLike) -> bool:
        """Whether some pair is nearer than it may be at the arm's configuration (n,)."""
        self._robot.put(self._q, q)
        self._set_margins()
        return bool(pin.computeCollisions(self._robot.model, self._data, self._manager, self._q, True))

    def contacts(self, q: ArrayLike) -> list[Contact]:
        """All pairs that are nearer than they may be, the deepest first."""
        found = [self._contact(k) for k in self._colliding(q)]
        return sorted(found, key=lambda contact: contact.distance - contact.required)

    def relax(self, q: ArrayLike, allowance: float, estimates: float | None = None) -> Contact | None:
        """Let pairs that are too near at `q` stay as near as they are: an arm must be able to leave where it is.

        Args:
            q: (n,) where a motion starts.
            allowance: Overlap that is taken for an error of measurement, m.
            estimates: The same for pairs with boxes that are only estimated (all but `fixed`), m.

        Returns:
            A pair that overlaps deeper than that (nothing is relaxed then), or None.
        """
        if not self.collides(q):
            return None
        colliding = self._colliding(q)
        contacts = [self._contact(k) for k in colliding]
        guessed = ({box.id for box in self._around.boxes} | {MAP}) - self._around.fixed
        for contact in contacts:
            limit = allowance if estimates is None or contact.second not in guessed else estimates
            if contact.distance < -limit:
                return contact
        seen = self._around.map
        if seen is not None and any(c.second == MAP and c.distance < 2.0 * _LESS for c in contacts):
            # where the robot is there is nothing else: such cells are errors of the map
            cells = self._cells_at(q, [k for k in colliding if self._names[self._pair_index[k][1]] == MAP])
            self._build(replace(self._around, map=seen.minus(cells)))
            return self.relax(q, allowance, estimates)
        for k, contact in zip(colliding, contacts, strict=True):
            self._required[k] = contact.distance - _LESS
        self._set = False
        return None

    def passing(self, q: ArrayLike, nearer: float) -> AbstractContextManager[None]:
        """Let what is next to cells of the map at `q` come nearer to them by `nearer` meanwhile, without contact, m."""
        self._colliding(q)
        asked = self._required.copy()
        for k, (_, j) in enumerate(self._pair_index):
            if self._names[j] == MAP:
                asked[k] = min(asked[k], max(self._contact(k).distance - nearer, 0.0))
        return self._asking(asked)

    def lenient(self, share: float, arms: float | None = None) -> AbstractContextManager[None]:
        """Ask for only a share of each positive distance meanwhile, `arms` of that to the other arm."""
        shares = np.where(self._arms, share if arms is None else arms, share)
        return self._asking(np.where(self._required > 0.0, shares * self._required, self._required))

    @contextmanager
    def _asking(self, required: Array) -> Iterator[None]:
        asked = self._required
        self._required, self._set = required, False
        try:
            yield
        finally:
            self._required, self._set = asked, False

    def place(self, id: str, T: Array) -> None:
        """Move a box: `T` in the base frame, or in the tool frame for a held one."""
        held = self._held_name(id) in self._boxes
        index = self._boxes[self._held_name(id) if held else id]
        self._geometry.geometryObjects[index].placement = pin.SE3(self._robot.kinematics.tip @ T if held else T)
        self._measure()

    def _measure(self) -> None:
        """Set how far points are from the joints' axes, what is held included."""
        held = [self._geometry.geometryObjects[self._boxes[self._held_name(b.id)]] for b in self._around.held]
        self.levers = np.max([self._robot.levers, *(self._robot.levers_of(o) for o in held)], axis=0)

    def set_state(self, state: Mapping[str, float]) -> None:
        """Move the robot's other joints."""
        self._q = self._robot.configuration(state)

    def gap(self, q: ArrayLike, links: frozenset[str]) -> float:
        """Smallest distance between what moves and some links, m (< 0: overlap); infinite where no pair is checked."""
        self._robot.put(self._q, q)
        pin.updateGeometryPlacements(self._robot.model, self._data, self._geometry, self._geometry_data, self._q)
        if links not in self._towards:
            pairs = [(k, i, j) for k, (i, j) in enumerate(self._pair_index) if self._names[j] in links]
            self._towards[links] = np.array(pairs, np.int64).reshape(-1, 3).T
        rows, first, second = self._towards[links]
        if not rows.size:
            return float("inf")
        used = {int(i): self._ball(int(i)) for i in np.unique(np.concatenate([first, second]))}
        centres, radii = np.zeros((max(used) + 1, 3)), np.zeros(max(used) + 1)
        for i, (centre, radius) in used.items():
            centres[i], radii[i] = centre, radius
        # balls about the shapes say which pairs are worth a check
        least = np.linalg.norm(centres[first] - centres[second], axis=1) - radii[first] - radii[second]
        best = float("inf")
        for n in np.argsort(least):
            if least[n] >= best:
                break
            best = min(best, self._contact(int(rows[n])).distance)
        return best

    def _ball(self, i: int) -> tuple[Array, float]:
        """Centre (3,) and radius of the ball about a shape where it is now."""
        shape = self._geometry.geometryObjects[i].geometry
        if i not in self._balls:
            shape.computeLocalAABB()
            self._balls[i] = np.asarray(shape.aabb_center).ravel(), float(shape.aabb_radius)
        centre, radius = self._balls[i]
        return np.asarray(self._geometry_data.oMg[i].act(centre)), radius

    def put_other(self, other: CollisionRobot, q: ArrayLike) -> None:
        """Move another arm of the same robot to its configuration (n,)."""
        other.put(self._q, q)

    def _colliding(self, q: ArrayLike) -> list[int]:
        self._robot.put(self._q, q)
        self._set_margins()
        pin.computeCollisions(self._robot.model, self._data, self._geometry, self._geometry_data, self._q, False)
        results = self._geometry_data.collisionResults
        return [k for k in range(len(self._pair_index)) if results[k].isCollision()]

    def _cells_at(self, q: ArrayLike, pairs: Sequence[int]) -> NDArray[np.int64]:
        """Rows of the map's cells that the shapes of some pairs touch at a configuration."""
        seen = self._around.map
        if seen is None:
            return np.empty(0, np.int64)
        self._colliding(q)
        found = set[int]()
        for k in pairs:
            i = self._pair_index[k][0]
            place = coal.Transform3s(self._geometry_data.oMg[i].rotation, self._geometry_data.oMg[i].translation)
            found |= seen.touched(self._geometry.geometryObjects[i].geometry, place, self._ball(i), 2.0 * _LESS)
        return np.array(sorted(found), np.int64)

    def _contact(self, k: int) -> Contact:
        result = pin.computeDistance(self._geometry, self._geometry_data, k)
        i, j = self._pair_index[k]
        distance, where = min(float(result.min_distance), _REPORT_RANGE), ""
        if self._names[j] == MAP and self._around.map is not None:
            x, y, z = self._around.map.at(np.asarray(result.getNearestPoint2()).ravel())
            where = f" at ({x:.2f}, {y:.2f}, {z:.2f})"
        return Contact(self._names[i], self._names[j], distance, float(self._required[k]), where)

    @property
    def pairs(self) -> int:
        """How many pairs are checked."""
        return len(self._pair_index)

    def swings(self) -> Array:
        """See `LineChecks`."""
        return self.swings_of([self._robot])

    def swings_of(self, robots: Sequence[CollisionRobot]) -> Array:
        """As `swings`, of the joints of several arms of the same robot one after the other."""
        pairs = np.array(self._pair_index, np.int64).reshape(-1, 2)
        out: list[Array] = []
        for robot in robots:
            more = [robot.levers_of(o) for o in self._geometry.geometryObjects.tolist()[len(robot.links) :]]
            levers = np.concatenate([robot.shape_levers, np.array(more).reshape(-1, robot.kinematics.n)])
            one, two = levers[pairs[:, 0]], levers[pairs[:, 1]]
            # a joint that moves both moves them as one body
            out.append(np.where((one > 0.0) & (two > 0.0), 0.0, one + two))
        return np.hstack(out)

    def further(self, by: Array) -> AbstractContextManager[None]:
        """See `LineChecks`."""
        return self._asking(self._required + by)

    def _set_margins(self) -> None:
        """Tell coal the distances that pairs must keep, where they have changed since."""
        if self._set:
            return
        self._set = True
        for request, margin in zip(self._geometry_data.collisionRequests, self._required.tolist(), strict=True):
            request.security_margin = margin
        self._manager = pin.BroadPhaseManager_NaiveCollisionManager(
            self._robot.model, self._geometry, self._geometry_data
        )

    def _pairs(self, known: Sequence[tuple[int, int]]) -> tuple[list[tuple[int, int]], list[float]]:
        """Add the boxes to the geometry; all pairs to check, the known ones first, and the distance of each."""
        robot, around, keep = self._robot, self._around, self._around.clearance
        own = robot.arm.fixed | robot.arm.moving
        pairs = [*known]
        required = [self._asked_of(i, j) if robot.links[j] in own else keep.arms for i, j in pairs]
        tool = robot.joints[-1]
        held = [self._add(self._held_name(box.id), tool, robot.kinematics.tip @ box.T, box) for box in around.held]
        for h in held:
            for i, link in enumerate(robot.links):
                if link not in robot.arm.hand and (around.own or link not in own):
                    pairs.append((h, i))
                    required.append(
                        keep.own if link in robot.arm.moving else keep.arms if link not in own else keep.world
                    )
        for joint, box in around.carried:
            b = self._add(box.id, joint, box.T, box)
            pairs += [(i, b) for i in (*robot.moving, *held)]
            required += [keep.arms] * (len(robot.moving) + len(held))
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
        if around.map is not None and len(around.map.indices):
            m = self._put_in(MAP, 0, np.eye(4), around.map.octree)
            for i, distance in self._from_map().items():
                pairs.append((i, m))
                required.append(distance)
        return pairs, required

    def _asked_of(self, i: int, j: int) -> float:
        """Distance that two shapes of the arm and the body must keep, m."""
        own, links = self._around.clearance.own, self._robot.links
        return min(own, max(0.0, self._robot.apart.get(frozenset((links[i], links[j])), math.inf) - _ROUNDED))

    @staticmethod
    def _held_name(id: str) -> str:
        return f"{_HELD}{id}"

    def _add(self, name: str, joint: int, T: Array, solid: Solid) -> int:
        if name in self._boxes or name == MAP:
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"two boxes have the id {solid.id!r}; ids must be unique ({MAP!r} is taken)"
            )
        self._solids[name] = solid
        return self._put_in(name, joint, T, solid.geometry)

    def _put_in(self, name: str, joint: int, T: Array, geometry: coal.CollisionGeometry) -> int:
        self._names.append(name)
        self._boxes[name] = int(self._geometry.addGeometryObject(pin.GeometryObject(name, joint, pin.SE3(T), geometry)))
        return self._boxes[name]
