# SPDX-License-Identifier: Apache-2.0
"""Whether a hand can take an object as it lies, by the true shape alone: no image, no sampler, no planner.

A hand can take an object where, coming straight down or tilted by up to 45° about its horizontal closing axis, all that
is between its fingers is narrower than its aperture less 6 mm, nothing is in the way of hand and fingers, the tips keep
clear of the table, both pads meet enough of the object, opposite to each other, and an arm
reaches the grasp, the way to it and the way up. World frame = base frame, m, rad.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.objects.resting import least_box_yaw
from openarm_common.objects.solid import Part, crossings
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_name
from openarm_common.robot.work import Table
from openarm_common.types import Array, Ints
from openarm_motion.config import MotionConfig
from openarm_motion.planning.workplace import reached
from openarm_motion.service.motion_service import make_arms, table_box

#: Aperture that is kept as room, m.
ROOM = 0.006
#: Steepest tilt from straight down, and steps of tilt and of the direction of closing, rad.
_TILTS = tuple(math.radians(tilt) for tilt in (0, 15, -15, 30, -30, 45, -45))
_TURNS = 12
#: Pitch of the voxels of an object, of places that are tried, and of depths, m.
_PITCH, _PLACE, _DEPTH = 0.0025, 0.005, 0.006
#: Tips above the table, m.
_TABLE_ROOM = 0.003
#: A pad touches what is within this of the first contact, m; the object must reach so far along and across it, m.
_TOUCH, _ALONG, _ACROSS = 0.0005, 0.004, 0.004
#: How much a face may lean from a pad at whose border it is met, and the line between contacts from the closing axis:
#: well within the friction cone of the pads, since the weight pulls, too; rad.
_LEAN, _CONE = math.radians(15.0), math.radians(20.0)
#: Straight way to the grasp and up from it, m; kept from joint limits, rad.
_BACK, _UP, _MARGIN = 0.06, 0.08, 0.02
#: Grasps of one direction, and of all, whose reach is looked at.
_TRIED, _TRIED_IN_ALL = 4, 120
#: Places of one direction at which the hold is looked at.
_PLACES = 200
_CLOSING = np.array([0.0, 1.0, 0.0])


@dataclass(frozen=True)
class Graspable:
    """Whether an object can be taken as it lies.

    Attributes:
        yes: Whether.
        reason: Why not; "" where it can be.
        arm: Arm that reaches it.
        width: Between the pads, m.
        tilt: Angle from straight down, rad.
        T_base_tcp: (4, 4) of the hand; None where it can't be.
    """

    yes: bool
    reason: str = ""
    arm: str = ""
    width: float = 0.0
    tilt: float = 0.0
    T_base_tcp: Array | None = None


@dataclass(frozen=True, eq=False)
class HandShape:
    """An open hand in the frame of its TCP: z out of the fingers, y the closing axis. m.

    Attributes:
        boxes: (n, 2, 3) low and high corner of each box about a collision shape.
        pad: (2, 3) the space between the pads, from one to the other.
    """

    boxes: Array
    pad: Array

    @staticmethod
    def of(robot: RobotDescription, arm: str) -> HandShape:
        """Return the shape of a hand that is open for a grasp."""
        parts, hand = robot.arm(arm), robot.hand(arm)
        poses = robot.link_poses(dict.fromkeys(robot.joints, 0.0) | {hand.joint: hand.opened})
        T_tcp_base = se3.inverse(poses[parts.tcp])
        boxes: list[Array] = []
        pads: list[Array] = []
        for link in (parts.hand, *parts.fingers):
            for shape in robot.links[link].collision:
                points = shape.corners
                if points is None:
                    half = _half(shape.kind, shape.size)
                    points = half * np.array(list(product((-1.0, 1.0), repeat=3)))
                points = se3.apply(T_tcp_base @ poses[link] @ shape.T_link_primitive, points)
                boxes.append(np.stack([points.min(axis=0), points.max(axis=0)]))
                if "pad" in shape.name:
                    pads.append(boxes[-1])
        faces = np.array(pads or boxes[1:])
        low, high = faces[:, 0].max(axis=0), faces[:, 1].min(axis=0)
        opening = hand.parts.opening
        return HandShape(np.array(boxes), np.array([[low[0], -opening, low[2]], [high[0], opening, high[2]]]))


def _half(kind: str, size: Sequence[float]) -> Array:
    if kind == "box":
        return 0.5 * np.array(size)
    return np.array([size[0], size[0], 0.5 * size[1]]) if kind == "cylinder" else np.full(3, size[0])


class GraspJudge:
    """Decides for the robot of this process.

    Args:
        table: Under the objects.
    """

    def __init__(self, table: Table) -> None:
        self._robot = RobotDescription.load()
        self._table = table
        self._arms = make_arms(MotionConfig(), self._robot, (table_box(table),))
        self._hands = {arm: HandShape.of(self._robot, arm) for arm in self._arms}
        self._home: dict[str, float] = dict.fromkeys(self._robot.joints, 0.0)
        for arm in self._robot.arm_names:
            self._home |= self._robot.group_state(f"{arm}_arm", "home")

    @staticmethod
    def at(table: Table) -> GraspJudge:
        """Return the judge of this process's robot at a table, made once."""
        key = (robot_name(), table.model_dump_json())
        if key not in _JUDGES:
            _JUDGES[key] = GraspJudge(table)
        return _JUDGES[key]

    def decide(self, parts: Sequence[Part], T_world_object: Array) -> Graspable:
        """Decide for an object.

        Args:
            parts: Convex parts in the frame of the object.
            T_world_object: (4, 4) where it lies.
        """
        placed = [part.moved(T_world_object) for part in parts]
        seen: list[float] = []
        # the arm on whose side it is comes first: it mostly reaches, and one grasp is enough
        y = float(np.mean([part.centre[1] for part in placed]))
        order = sorted(self._arms, key=lambda arm: (self._base_y(arm) - y) ** 2)
        sections = 0
        edge = least_box_yaw(np.concatenate([part.vertices[:, :2] for part in placed]))
        turns = (edge, edge + 0.5 * math.pi, *(turn * math.pi / _TURNS for turn in range(_TURNS)))
        for tilt, turn in product(_TILTS, turns):
            if sections >= _TRIED_IN_ALL:
                break
            R = _hand_axes(turn, tilt)
            for k, arm in enumerate(order):
                if k and self._same_hand(arm, order[0]):
                    continue  # what one hand can close on, the other can: reach is asked of both below
                for T, width in _sections(placed, R, self._hands[arm], self._table.top_z):
                    sections += 1
                    seen.append(width)
                    for one in order if self._same_hand(arm, order[0]) else (arm,):
                        if (pose := self._reached(one, T)) is not None:
                            return Graspable(True, "", one, width, abs(tilt), pose)
        if sections:
            return Graspable(False, f"out of reach: no arm gets to any of {sections} grasps looked at", width=min(seen))
        widest = 1e3 * (self._hands[order[0]].pad[1, 1] * 2.0 - ROOM)
        return Graspable(False, f"no section that the hand can close on: none up to {widest:.0f} mm wide is free")

    def _reached(self, arm: str, T: Array) -> Array | None:
        """Return the pose with which an arm gets to a grasp, from where and to where it has to go; None: it can't."""
        scene = self._arms[arm].scene(self._home, straight=True, gripper=self._arms[arm].opened)
        return reached(self._arms[arm], scene, T, _BACK, _UP, _MARGIN)

    def _base_y(self, arm: str) -> float:
        return float(self._robot.link_poses(self._home)[self._robot.tcp_link(arm)][1, 3])

    def _same_hand(self, a: str, b: str) -> bool:
        one, other = self._hands[a], self._hands[b]
        return one.boxes.shape == other.boxes.shape and bool(
            np.allclose(_mirrored(one.boxes), _mirrored(other.boxes), atol=2e-3)
        )


#: Judges by robot and table; making one takes a second.
_JUDGES: dict[tuple[str, str], GraspJudge] = {}


def _mirrored(boxes: Array) -> Array:
    """Return boxes sorted, so that hands that differ by the order of their shapes are the same."""
    flat = boxes.reshape(len(boxes), -1)
    return flat[np.lexsort(np.round(flat, 2).T)]


def _hand_axes(turn: float, tilt: float) -> Array:
    """Return the axes (3, 3) of a hand whose closing axis is horizontal."""
    y = np.array([math.cos(turn), math.sin(turn), 0.0])
    heading = np.array([-y[1], y[0], 0.0])
    z = math.sin(tilt) * heading - math.cos(tilt) * np.array([0.0, 0.0, 1.0])
    return np.stack([np.cross(y, z), y, z], axis=1)


def _sections(parts: Sequence[Part], R: Array, hand: HandShape, top_z: float) -> Iterator[tuple[Array, float]]:
    """Yield poses (4, 4) of the TCP and widths with which a hand of some direction can close on parts."""
    grid = _Grid.of(parts, R)
    aperture = hand.pad[1, 1] * 2.0
    # how deep the TCP may go: the lowest corner of the hand stays above the table
    corners = np.array(
        [[box[i, 0], box[j, 1], box[k, 2]] for box in hand.boxes for i, j, k in product((0, 1), repeat=3)]
    )
    lowest = float((corners @ R.T)[:, 2].min())
    x, y, z = _places(grid, hand, R, top_z + _TABLE_ROOM - lowest)
    if not len(x):
        return
    inner = hand.pad + np.array([[0.0, ROOM / 2.0, 0.0], [0.0, -ROOM / 2.0, 0.0]])
    keep = grid.count(inner, x, y, z) > 0
    x, y, z = x[keep], y[keep], z[keep]
    # the fingers with the room that is kept, and all behind them, come through nothing
    blocked = hand.boxes.copy()
    beside = blocked[:, 0, 1] >= aperture / 2.0 - 1e-3
    blocked[beside, 0, 1] -= ROOM / 2.0
    beside = blocked[:, 1, 1] <= -aperture / 2.0 + 1e-3
    blocked[beside, 1, 1] += ROOM / 2.0
    for box in blocked:
        free = grid.behind(box, x, y, z) == 0
        x, y, z = x[free], y[free], z[free]
    middle = grid.centre
    order = np.argsort((x - middle[0]) ** 2 + (y - middle[1]) ** 2 - 0.3 * z, kind="stable")
    order = order[:: 1 + len(order) // _PLACES]
    found = 0
    for k in order:
        width = grid.held(inner, np.array([x[k], y[k], z[k]]))
        if width is None:
            continue
        yield se3.make(R, R @ np.array([x[k], y[k], z[k]])), width
        found += 1
        if found == _TRIED:
            return


def _places(grid: _Grid, hand: HandShape, R: Array, floor: float) -> tuple[Array, Array, Array]:
    """Return places (n,) of the TCP in the axes of the hand: across, along the closing axis, and deep."""
    low, high = grid.low, grid.high
    xs = np.arange(low[0], high[0] + _PLACE, _PLACE)
    ys = np.append(np.arange(low[1], high[1] + _PLACE, _PLACE), 0.5 * (low[1] + high[1]))  # all of it, and parts
    # the tips reach the object at least, the palm goes no deeper than its far side
    zs = np.arange(low[2] - hand.pad[1, 2] + _ALONG, high[2] + _DEPTH, _DEPTH)
    if abs(R[2, 2] + 1.0) < 1e-9:  # straight down, the table is a depth: try the deepest place exactly
        zs = np.append(zs[zs < -floor], -floor)
    x, y, z = (values.ravel() for values in np.meshgrid(xs, ys, zs, indexing="ij"))
    above = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z >= floor - 1e-9
    return x[above], y[above], z[above]


@dataclass(frozen=True, eq=False)
class _Grid:
    """Voxels of an object in the axes of a hand: [x, z, y].

    Attributes:
        ends: (parts, x, z, 2) where lines along y are in each part, m; normals: (parts, x, z, 2) y of faces there.
        low: (3,) corner of the first voxel, x, y, z, m.
        high: (3,) of the last.
        full: Voxels that the object is in.
        sums: Sums of `full` from the first corner.
        sums_behind: Sums over x and y of voxels that have the object in them or behind them.
        centre: Centre of mass (3,), m.
    """

    ends: Array
    normals: Array
    low: Array
    high: Array
    full: NDArray[np.bool_]
    sums: Ints
    sums_behind: Ints
    centre: Array

    @staticmethod
    def of(parts: Sequence[Part], R: Array) -> _Grid:
        turned = [part.moved(se3.make(R.T)) for part in parts]
        points = np.concatenate([part.vertices for part in turned])
        low, high = points.min(axis=0) - _PITCH, points.max(axis=0) + _PITCH
        n = np.ceil((high - low) / _PITCH).astype(np.int64)
        full = np.zeros((n[0], n[2], n[1]), np.bool_)
        middles = [low[axis] + (np.arange(n[axis]) + 0.5) * _PITCH for axis in range(3)]
        ends = np.empty((len(turned), n[0], n[2], 2))
        ends[:] = np.inf, -np.inf
        normals = np.zeros_like(ends)
        for number, part in enumerate(turned):
            first = np.floor((part.vertices.min(axis=0) - low) / _PITCH).astype(np.int64)
            last = np.ceil((part.vertices.max(axis=0) - low) / _PITCH).astype(np.int64)
            i, k = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[2], last[2]), indexing="ij")
            i, k = i.ravel(), k.ravel()
            starts = np.stack([middles[0][i], np.zeros(len(i)), middles[2][k]], axis=1)
            found = crossings(part, starts, _CLOSING)
            inside = found.ends[:, :1] < middles[1]
            inside &= found.ends[:, 1:] > middles[1]
            inside &= (found.ends[:, 1] > found.ends[:, 0])[:, None]
            ends[number, i, k], normals[number, i, k] = found.ends, found.normals[:, :, 1]
            full[i, k] |= inside
        behind = np.logical_or.accumulate(full, axis=1)
        sums = np.pad(full.astype(np.int64), ((1, 0),) * 3).cumsum(0).cumsum(1).cumsum(2)
        flat = np.pad(behind.astype(np.int64), ((1, 0), (0, 0), (1, 0))).cumsum(0).cumsum(2)
        volumes = np.array([part.volume for part in turned])
        centre = volumes @ np.array([part.centre for part in turned]) / volumes.sum()
        return _Grid(ends, normals, low, low + n * _PITCH, full, sums, flat, centre)

    def _index(self, values: Array, axis: int, up: bool) -> Ints:
        at = (values - self.low[axis]) / _PITCH
        whole = np.ceil(at - 1e-6) if up else np.floor(at + 1e-6)
        size = self.full.shape[(0, 2, 1)[axis]]
        return np.clip(whole, 0, size).astype(np.int64)

    def count(self, box: Array, x: Array, y: Array, z: Array) -> Ints:
        """Return how many voxels (n,) of the object are in a box (2, 3) at places."""
        (i, j, k), (a, b, c) = self._ends(box, x, y, z)
        s = self.sums
        upper = s[a, c, b] - s[i, c, b] - s[a, c, j] + s[i, c, j]
        return upper - (s[a, k, b] - s[i, k, b] - s[a, k, j] + s[i, k, j])

    def behind(self, box: Array, x: Array, y: Array, z: Array) -> Ints:
        """Return how many columns (n,) of the object a box (2, 3) would meet that comes from behind to places."""
        (i, j, _), (a, b, c) = self._ends(box, x, y, z)
        s, deep = self.sums_behind, np.maximum(c - 1, 0)
        met = s[a, deep, b] - s[i, deep, b] - s[a, deep, j] + s[i, deep, j]
        return np.where(c > 0, met, 0)

    def _ends(self, box: Array, x: Array, y: Array, z: Array) -> tuple[tuple[Ints, ...], tuple[Ints, ...]]:
        at = (x, y, z)
        low = tuple(self._index(at[axis] + box[0, axis], axis, up=False) for axis in range(3))
        high = tuple(self._index(at[axis] + box[1, axis], axis, up=True) for axis in range(3))
        return low, high

    def held(self, box: Array, at: Array) -> float | None:
        """Return the width of what pads at a place (3,) close on, m; None where they get no hold.

        A pad touches the object where it first meets it. Inside of the pad its own normal is that of the contact;
        at its border it is that of the object, which may lean a little; the line between some contacts of the two pads
        must be near to the closing axis.
        """
        (i, j, k), (a, b, c) = self._ends(box, *(np.array([value]) for value in at))
        del j, b
        rows = slice(int(i[0]), int(a[0])), slice(int(k[0]), int(c[0]))
        ends, normals = self.ends[:, *rows], self.normals[:, *rows]
        low, high = box[:, 1] + at[1]
        inside = (ends[..., 0] < ends[..., 1]) & (ends[..., 1] > low) & (ends[..., 0] < high)
        if (inside & ((ends[..., 0] < low) | (ends[..., 1] > high))).any():
            return None  # it reaches into the clearance of the fingers
        met = inside.any(axis=0)
        if not met.any():
            return None
        deep, across = (np.ptp(np.flatnonzero(met.any(axis=axis))) + 1 for axis in (0, 1))
        if _PITCH * across < _ACROSS or _PITCH * deep < _ALONG:
            return None
        first = np.where(inside, ends[..., 0], np.inf)
        last = np.where(inside, ends[..., 1], -np.inf)
        within = np.zeros_like(met)
        within[1:-1, 1:-1] = True
        contacts: list[Array] = []
        width = float(last.max() - first.min())
        for end, (depth, sign) in enumerate(((first, -1.0), (-last, 1.0))):
            part = depth.argmin(axis=0)
            nearest = np.take_along_axis(depth, part[None], axis=0)[0]
            normal = sign * np.take_along_axis(normals[..., end], part[None], axis=0)[0]
            holds = (nearest < nearest.min() + _TOUCH) & (within | (normal > math.cos(_LEAN)))
            if not holds.any():
                return None
            contacts.append(np.asarray(np.argwhere(holds), np.float64) * _PITCH)
        apart = float(np.linalg.norm(contacts[0][:, None] - contacts[1][None], axis=2).min())
        if width > np.ptp(box[:, 1]):
            return None
        return width if apart <= math.tan(_CONE) * max(width, _PITCH) else None
