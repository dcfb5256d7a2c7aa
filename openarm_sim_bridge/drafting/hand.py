# SPDX-License-Identifier: Apache-2.0
"""What `robot.yaml` says of a hand with two fingers, measured on its shapes, with its frame and pads. m, rad."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.types import Array
from openarm_sim_bridge.drafting.collisions import corners_of, hull_mesh

#: Positions of the finger joint at which a hand is measured; finger at which its frame and pads are made, m.
_STEPS, _USUAL = 9, 0.025
#: So far from the tips a finger may have its pad; what counts as flat; before what is measured a pad is, m.
_TIPS, _FLAT, _PROUD = 0.045, 0.0015, 0.0005
#: Edges of a pad across the opening direction: least and most; its thickness, m.
_EDGES, _THICK = ((0.008, 0.008), (0.05, 0.04)), 0.008
#: Room of tips over a surface, and of what is held before the palm; half of its width; its least finger, m.
_CLEAR, _HELD, _NARROW = 0.004, 0.03, 0.015
#: Finger of a hand that is open for a grasp, if it opens so far, and of one that is none, m; length of a tip, m.
_OPEN, _LEAST, _END = 0.044, 0.003, 0.01
#: Cosines: an axis so near to the opening direction is meant to be it, and one so near to that of the fingers.
_OPENS, _OUT = math.cos(math.radians(5.0)), math.cos(math.radians(20.0))
#: Farthest that the middle of the pads may be from a tool centre point to the side, and tips behind it, m.
_ASIDE, _BEHIND = 0.01, 0.012
#: A camera on a hand is no farther behind the tool centre point, m.
_BACK = 0.10
#: Inertia of a finger drive, of which no description speaks: kg of a slide, kg m2 of a hinge.
_ARMATURE = {"prismatic": 0.05, "revolute": 0.002}
#: Points along each edge of a triangle.
_GRAIN = 8


@dataclass(frozen=True, eq=False)
class MeasuredHand:
    """A hand.

    Attributes:
        parts: Measures, same as in `HandParts`.
        sign: Sign of the finger joint, as `ArmParts.finger_sign`.
        pads: Boxes to add by link: pose (4, 4) in the link, and edges (3,); none where it has a pad.
        T_tip_tcp: (4, 4) pose of the tool centre point in the link that was given for it; None: it is there.
    """

    parts: dict[str, Any]
    sign: int
    pads: Mapping[str, tuple[Array, Array]]
    T_tip_tcp: Array | None


@dataclass(frozen=True, eq=False)
class _FingerFlat:
    """The flat of a finger that faces the other one, in the tool frame.

    Attributes:
        side: Side of the middle on which it is, -1 or 1.
        low: Least x and z.
        high: Greatest x and z.
        y: Position of the flat along the closing axis, m.
        tip: Greatest z of the finger.
    """

    side: float
    low: Array
    high: Array
    y: float
    tip: float

    @property
    def middle(self) -> Array:
        """Its middle (3,)."""
        x, z = 0.5 * (self.low + self.high)
        return np.array([x, self.y, z])


def measured(robot: RobotDescription, arm: Mapping[str, Any]) -> MeasuredHand | None:
    """Measure the hand of an arm, as `arm_parts` returns it; None where it has no two fingers that meet.

    Pads are boxes in front of the flat of each finger. What is measured is right to the millimetres by which the hulls
    of a draft are larger than the meshes.
    """
    hand = _HandGeometry(robot, arm)
    if len(arm["fingers"]) != 2 or not all(len(hand.surfaces[link]) for link in arm["fingers"]):
        return None
    closed, opened = sorted((hand.joint.lower, hand.joint.upper), key=hand.apart)
    positions = np.linspace(closed, opened, _STEPS)
    T_tip_tcp = hand.frame(float(positions[_STEPS // 2]))
    if T_tip_tcp is None:
        return None
    fingers = np.array([0.5 * sum(face.side * face.y for face in hand.faces(q, T_tip_tcp)) for q in positions])
    usual = float(positions[np.abs(fingers - _USUAL).argmin()])
    first = hand.faces(usual, T_tip_tcp)
    middle = np.mean([face.middle for face in first], axis=0)
    near = np.abs(middle[:2]).max() <= _ASIDE and -_TIPS <= -max(face.tip for face in first) <= _BEHIND
    there = np.array_equal(T_tip_tcp, np.eye(4)) and near
    if not there:
        T_tip_tcp = T_tip_tcp @ se3.make(p=middle)
        first = hand.faces(usual, T_tip_tcp)
    pads = {
        link: _pad(face, 0.0 if hand.has_pad(link) else _PROUD)
        for link, face in zip(arm["fingers"], first, strict=True)
    }
    rows = np.array([hand.row(q, usual, pads, T_tip_tcp) for q in positions])
    sign = 1 if closed == hand.joint.lower else -1
    placed = {
        link: (hand.in_link(link, usual, T_tip_tcp) @ T, size)
        for link, (T, size) in pads.items()
        if not hand.has_pad(link)
    }
    parts = _parts(rows, sign * positions + 0.0, hand.joint.type)
    return None if parts is None else MeasuredHand(parts, sign, placed, None if there else T_tip_tcp)


def reach_of_hand(robot: RobotDescription, arm: str) -> tuple[float, float]:
    """Return how far the shapes of an arm's hand reach along x of its tool frame, and how far back they begin, m."""
    parts = robot.arm(arm)
    hand = _HandGeometry(robot, parts.model_dump())
    points = hand.points(list(hand.surfaces), robot.hand(arm).opened, np.eye(4))
    back = min(-float(points[:, 2].min()), _BACK)
    return float(points[points[:, 2] > -back - 0.03][:, 0].max()), back


def _parts(rows: Array, positions: Array, kind: str) -> dict[str, Any] | None:
    """`HandParts` of what `_HandGeometry.row` returns from closed to open; None where that does not open."""
    rising = [0]
    for k in range(1, len(rows)):
        if rows[k, 0] > rows[rising[-1], 0] + 1e-4:
            rising.append(k)
    if len(rising) < 2 or rows[rising[-1], 0] < _LEAST:
        return None
    rows, positions = rows[rising], positions[rising]
    finger, z = rows[:, 0], rows[:, 1]
    usual = float(np.interp(_USUAL, finger, z))
    shift = z - usual + max(usual, 0.0)
    table = np.stack([positions, finger], axis=1)
    parts = {
        "fingers": (table[[0, -1]] if kind == "prismatic" else table).round(5).tolist(),
        "tcp": np.stack([finger, shift], axis=1).round(5).tolist()
        if np.ptp(shift) > 5e-4
        else [[0.0, max(usual, 0.0)]],
        "opening": math.floor(1e4 * min(finger[-1], _OPEN)) / 1e4,
        "tip_clearance": (rows[:, 2] - shift).max() + _CLEAR,
        "tip_clearance_tilted": rows[:, 4].max(),
        "pad_centre": -usual,
        "palm_depth": -(rows[:, 3] - shift)[finger >= min(_NARROW, finger[-1])].max() - _CLEAR,
        "palm_depth_tilted": _HELD,
        "armature": _ARMATURE.get(kind, 0.002),
    }
    lengths = ("tip_clearance", "tip_clearance_tilted", "pad_centre", "palm_depth")
    return parts | {key: round(float(np.clip(parts[key], 0.0, 0.2)), 4) for key in lengths}


def _pad(face: _FingerFlat, proud: float) -> tuple[Array, Array]:
    """Pose (4, 4) and edges (3,) of a pad in the tool frame, so far in front of the flat."""
    x, z = np.clip(face.high - face.low, *_EDGES)
    aside = face.side * (0.5 * _THICK - proud)
    return se3.make(p=face.middle + np.array([0.0, aside, 0.0])), np.array([x, _THICK, z])


class _HandGeometry:
    """The collision shapes beyond the last joint of an arm."""

    def __init__(self, robot: RobotDescription, arm: Mapping[str, Any]) -> None:
        self._robot, self._arm = robot, arm
        self.joint = robot.joints[arm["finger_joint"]]
        #: Points (n, 3) of each link, in its frame.
        self.surfaces = {
            name: np.concatenate([np.zeros((0, 3)), *map(surface, link.collision)])
            for name, link in robot.links.items()
            if arm["flange"] in {name, *(joint.parent for joint in robot.chain(name))}
        }

    def has_pad(self, link: str) -> bool:
        """Whether a link has a shape that is its pad."""
        return any(shape.name == f"{link}_pad_collision" for shape in self._robot.links[link].collision)

    def in_link(self, link: str, q: float, T_tip_tcp: Array) -> Array:
        """Pose (4, 4) of the tool frame in a link."""
        poses = self._poses(q)
        return se3.inverse(poses[link]) @ poses[self._arm["tcp"]] @ T_tip_tcp

    def apart(self, q: float) -> float:
        """Distance of the middles of both fingers."""
        return float(np.linalg.norm(np.subtract(*self._middles(q, np.eye(4)))))

    def frame(self, q: float) -> Array | None:
        """Axes of the tool frame in the tip link, (4, 4): its own where they are along the fingers; None: unknown."""
        first, second = self._middles(q, np.eye(4))
        opening = first - second
        palm = self.points([self._arm["hand"], self._arm["flange"]], q, np.eye(4))
        if len(palm) == 0 or np.linalg.norm(opening) < 1e-3:
            return None
        opening /= np.linalg.norm(opening)
        out = 0.5 * (first + second) - palm.mean(axis=0)
        out -= opening * (opening @ out)
        if np.linalg.norm(out) < 1e-3:
            return None
        opening, out = _snapped(opening, _OPENS), _snapped(out / np.linalg.norm(out), _OUT)
        if opening @ np.ones(3) < 0.0:
            opening = -opening  # either end will do: the given one, where it is an axis
        return se3.make(se3.rotation_from_z_y(out, opening).round(12) + 0.0)

    def faces(self, q: float, T_tip_tcp: Array) -> tuple[_FingerFlat, _FingerFlat]:
        """The flats of both fingers."""
        one, other = (self._face(link, q, T_tip_tcp) for link in self._arm["fingers"])
        return one, other

    def row(
        self, q: float, usual: float, pads: Mapping[str, tuple[Array, Array]], T_tip_tcp: Array
    ) -> tuple[float, float, float, float, float]:
        """Finger, z of pads, tips and palm, and half of the width of the tips, with the joint at a position."""
        fingers, ends, tips, widths = list[float](), list[float](), list[float](), list[float]()
        for link, (T, size) in pads.items():
            side = math.copysign(1.0, T[1, 3])
            inner = T @ se3.make(p=(0.0, -0.5 * side * size[1], 0.0))
            moved = se3.inverse(self.in_link(link, q, T_tip_tcp)) @ self.in_link(link, usual, T_tip_tcp) @ inner
            fingers.append(side * float(moved[1, 3]))
            ends.append(float(moved[2, 3]))
            points = self.points([link], q, T_tip_tcp)
            tips.append(float(points[:, 2].max()))
            widths.append(float(np.abs(points[points[:, 2] > tips[-1] - _END][:, 0]).max()))
        finger = float(np.mean(fingers))
        carried = [link for link in self.surfaces if link not in pads]
        points = self.points(carried, q, T_tip_tcp)
        between = points[(np.abs(points[:, 1]) < max(finger, _NARROW)) & (np.abs(points[:, 0]) < _HELD)]
        return finger, float(np.mean(ends)), max(tips), float(between[:, 2].max(initial=-0.2)), max(widths)

    def _face(self, link: str, q: float, T_tip_tcp: Array) -> _FingerFlat:
        points = self.points([link], q, T_tip_tcp)
        tip, side = float(points[:, 2].max()), math.copysign(1.0, float(points[:, 1].mean()))
        if self.has_pad(link):
            shapes = [s for s in self._robot.links[link].collision if s.name == f"{link}_pad_collision"]
            points = se3.apply(se3.inverse(self.in_link(link, q, T_tip_tcp)), surface(shapes[0]))
        near = points[points[:, 2] > tip - _TIPS]
        y = float((side * near[:, 1]).min())
        flat = near[side * near[:, 1] < y + _FLAT][:, [0, 2]]
        return _FingerFlat(side, flat.min(axis=0), flat.max(axis=0), side * y, tip)

    def _middles(self, q: float, T_tip_tcp: Array) -> list[Array]:
        found = [self.points([link], q, T_tip_tcp) for link in self._arm["fingers"]]
        return [0.5 * (points.min(axis=0) + points.max(axis=0)) for points in found]

    def points(self, links: list[str], q: float, T_tip_tcp: Array) -> Array:
        """Points (n, 3) of links in the tool frame."""
        poses = self._poses(q)
        T = se3.inverse(poses[self._arm["tcp"]] @ T_tip_tcp)
        return np.concatenate([np.zeros((0, 3)), *(se3.apply(T @ poses[link], self.surfaces[link]) for link in links)])

    def _poses(self, q: float) -> Mapping[str, Array]:
        return self._robot.link_poses({**dict.fromkeys(self._robot.joints, 0.0), self.joint.name: q})


def _snapped(v: Array, cosine: float) -> Array:
    """The axis that a direction (3,) is nearest to, if it is near."""
    k = int(np.abs(v).argmax())
    return np.copysign(np.eye(3)[k], v[k]) if abs(v[k]) >= cosine else v


def surface(shape: Primitive) -> Array:
    """Return points (n, 3) all over a shape, in the frame of its link; of a cylinder or sphere, of the box about it."""
    vertices, triangles = hull_mesh(corners_of(shape))
    weights = np.array([(i, j, _GRAIN - i - j) for i in range(_GRAIN + 1) for j in range(_GRAIN + 1 - i)]) / _GRAIN
    return np.einsum("wk,tkx->twx", weights, vertices[triangles]).reshape(-1, 3)
