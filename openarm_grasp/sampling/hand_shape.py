# SPDX-License-Identifier: Apache-2.0
"""The shape of an open hand and of its pads, from the robot's description: what a grasp needs room for.

Where a wide open hand has no room, such as inside of what is hollow, one that is opened less may have it.

It is made of the collision shapes of all links beyond the last joint of the arm, and of the housings of the cameras
that they carry, at their calibrated mounts. All lengths are m, in the frame of the tool centre point: z out of the
fingers, y the opening direction.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.types import Array

if TYPE_CHECKING:
    from scipy.spatial import ConvexHull

#: Distance of the points that stand for a surface: of fingers, and of everything else.
_FINE, _COARSE = 0.005, 0.008
#: Fingers (half apertures) at which pads and tips are known: this many from closed to open.
_STEPS = 12
#: A part of a finger is pad where it is this near to where pads are.
_PAD = 0.002
#: Hands that are opened less: shares of the opening.
_NARROWER = (0.7, 0.45, 0.25)
#: Rays that measure the inner side of a finger are so far apart, from this far behind the TCP to beyond it.
_RAY, _BEHIND, _BEYOND = 0.0015, 0.06, 0.02
#: Deeper in a piece is inside, m.
_INSIDE = 0.003
#: Sides of the prism that stands for a cylinder.
_SIDES = 16


@dataclass(frozen=True, eq=False)
class HandShape:
    """One arm's hand.

    Attributes:
        opening: Finger of the hand that is opened so, m.
        fingers: (m,) fingers at which `pads` and `tips` are known, ascending.
        pads: (m, 4) of the pads: least and greatest x, least and greatest z.
        tips: (m, 16, 3) corners of boxes about the ends of both fingers.
        points: (n, 3) of the surface of the open hand, the foremost first.
        planes: (k, 4) of the convex pieces of the open hand: inside where normal · p + offset <= 0.
        starts: (pieces + 1,) where the planes of each piece begin.
        narrower: The same hand opened less, widest first.
    """

    opening: float
    fingers: Array
    pads: Array
    tips: Array
    points: Array
    planes: Array
    starts: np.ndarray[tuple[int, ...], np.dtype[np.int64]]
    narrower: tuple[HandShape, ...] = ()

    @classmethod
    def of(cls, robot: RobotDescription, arm: str, cameras: Iterable[CameraConfig] = ()) -> HandShape:
        """Measure the hand of an arm.

        Args:
            robot: Robot of the hand.
            arm: Its name.
            cameras: Cameras at their mounts; those with a housing on the hand are part of it.

        Raises:
            OpenArmError: CONFIG_INVALID, when the robot has no hand, or its fingers no shape or no pads.
        """
        opening = robot.hand(arm).parts.opening
        pads, housings = _pads(robot, arm), _housings(robot, arm, cameras)
        shapes = [_opened(robot, arm, share * opening, pads, housings) for share in (1.0, *_NARROWER)]
        return replace(shapes[0], narrower=tuple(shapes[1:]))

    @property
    def reach(self) -> float:
        """Greatest distance of a point of the hand from the TCP, m."""
        return float(np.linalg.norm(self.points, axis=1).max())

    def holds(self, points: Array) -> Array:
        """How deep points (n, 3) lie in the open hand, m (n,); negative outside."""
        values = points @ self.planes[:, :3].T + self.planes[:, 3]
        deepest = [-values[:, a:b].max(axis=1) for a, b in zip(self.starts[:-1], self.starts[1:], strict=True)]
        return np.asarray(np.max(deepest, axis=0), dtype=np.float64)


def _pads(robot: RobotDescription, arm: str) -> tuple[Array, Array, Array]:
    """Return `fingers`, `pads` and `tips` of a hand.

    Raises:
        OpenArmError: CONFIG_INVALID, when its fingers have no pads.
    """
    hand = robot.hand(arm)
    steps = np.linspace(0.0, hand.parts.opening, _STEPS)
    pads, tips = np.empty((_STEPS, 4)), np.empty((_STEPS, 16, 3))
    for n, finger in enumerate(steps):
        both = _fingers(robot, arm, _pieces(robot, arm, hand.position(finger)))
        pads[n] = _pad(both, float(finger), f"arm {arm!r} of robot {robot.name!r}")
        tips[n] = _ends(both)
    return steps, pads, tips


def _opened(
    robot: RobotDescription, arm: str, opening: float, pads: tuple[Array, Array, Array], housings: list[Array]
) -> HandShape:
    """Shape of a hand whose finger is at `opening`, m."""
    every = _pieces(robot, arm, robot.hand(arm).position(opening))
    fingers = _fingers(robot, arm, every)
    rest = [corners for link, corners in every if link not in robot.arm(arm).fingers]
    pieces = [_hull(corners) for corners in (*fingers, *rest, *housings)]
    points = np.concatenate([_surface(hull, _FINE if n < len(fingers) else _COARSE) for n, hull in enumerate(pieces)])
    equations = [np.unique(hull.equations.round(9), axis=0) for hull in pieces]
    starts = np.cumsum([0, *(len(e) for e in equations)]).astype(np.int64)
    shape = HandShape(opening, *pads, points, np.concatenate(equations), starts)
    # what is inside of another piece is no surface; the foremost points meet things first
    points = points[shape.holds(points) < _INSIDE]
    return replace(shape, points=np.ascontiguousarray(points[np.argsort(-points[:, 2], kind="stable")]))


def _fingers(robot: RobotDescription, arm: str, pieces: list[tuple[str, Array]]) -> list[Array]:
    """Corners of the shapes of fingers among those of a hand.

    Raises:
        OpenArmError: CONFIG_INVALID, when there are none.
    """
    fingers = [corners for link, corners in pieces if link in robot.arm(arm).fingers]
    if not fingers:
        text = f"the fingers of arm {arm!r} of robot {robot.name!r} have no collision shapes: grasps need them"
        raise OpenArmError(Code.CONFIG_INVALID, text)
    return fingers


def _pieces(robot: RobotDescription, arm: str, position: float) -> list[tuple[str, Array]]:
    """Link and corners (n, 3), TCP frame, of each collision shape beyond the arm's last joint."""
    parts = robot.arm(arm)
    q = dict.fromkeys(robot.joints, 0.0) | {parts.finger_joint: position}
    T_tcp_root = se3.inverse(robot.link_pose(parts.tcp, q))
    found: list[tuple[str, Array]] = []
    for link in _beyond(robot, arm):
        T = T_tcp_root @ robot.link_pose(link, q)
        found += [(link, se3.apply(T @ p.T_link_primitive, _corners(p))) for p in robot.links[link].collision]
    return found


def _beyond(robot: RobotDescription, arm: str) -> list[str]:
    last = robot.arm_joints(arm)[-1]
    return [link for link in robot.links if any(joint.name == last for joint in robot.chain(link))]


def _corners(shape: Primitive) -> Array:
    """Corners (n, 3) of a convex shape about a collision shape, in its frame."""
    if shape.corners is not None:
        return shape.corners
    if shape.kind == "cylinder":
        turns = (np.arange(_SIDES) + 0.5) * 2.0 * np.pi / _SIDES
        radius, half = shape.size[0] / np.cos(np.pi / _SIDES), 0.5 * shape.size[1]
        ring = radius * np.stack([np.cos(turns), np.sin(turns)], axis=1)
        return np.concatenate([np.column_stack([ring, np.full(_SIDES, z)]) for z in (-half, half)])
    edges = np.array(shape.size if shape.kind == "box" else [2.0 * shape.size[0]] * 3)
    return _box(edges)


def _box(edges: Array) -> Array:
    return (np.indices((2, 2, 2)).reshape(3, -1).T - 0.5) * edges


def _housings(robot: RobotDescription, arm: str, cameras: Iterable[CameraConfig]) -> list[Array]:
    """Corners (8, 3) of the housings that the hand carries, TCP frame."""
    beyond, found = _beyond(robot, arm), list[Array]()
    q = dict.fromkeys(robot.joints, 0.0)
    for camera in cameras:
        if camera.housing is None or camera.parent not in beyond:
            continue
        T_tcp_parent = se3.inverse(robot.link_pose(robot.tcp_link(arm), q)) @ robot.link_pose(camera.parent, q)
        T = T_tcp_parent @ camera.T_parent_link @ camera.T_link_housing
        found.append(se3.apply(T, _box(np.array(camera.housing))))
    return found


def _hull(corners: Array) -> ConvexHull:
    from scipy.spatial import ConvexHull  # a client of the grasp node needs no hull

    return ConvexHull(corners)


def _surface(hull: ConvexHull, step: float) -> Array:
    """Points (n, 3) on and just below the surface of a convex hull, at most `step` apart along each axis of it.

    The lattice has the axes of the box that it is, or those of its longest extents.
    """
    corners = hull.points
    axes = corners[[4, 2, 1]] - corners[0] if len(corners) == 8 else np.zeros((3, 3))
    axes = axes / np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    box = np.allclose(axes @ axes.T, np.eye(3), atol=1e-6)  # corners in the order of `_box`
    if not box:
        axes = np.linalg.svd(corners - corners.mean(axis=0), full_matrices=False)[2]
    local = corners @ axes.T
    low, high = local.min(axis=0), local.max(axis=0)
    lines = [np.linspace(a, b, max(2, ceil((b - a) / step) + 1)) for a, b in zip(low, high, strict=True)]
    lattice = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3) @ axes
    inside = (lattice @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1)
    shell = 0.5 * step if box else step
    return np.concatenate([corners, lattice[(inside <= 1e-6) & (inside > -shell)]])


def _pad(fingers: list[Array], finger: float, where: str) -> Array:
    """Measure the pad: least and greatest x and z where the inner side of the finger is where the pad is.

    Raises:
        OpenArmError: CONFIG_INVALID, when no part of the finger is there.
    """
    side = [corners for corners in fingers if corners[:, 1].mean() > 0.0]
    width = max(float(np.abs(corners[:, 0]).max()) for corners in side)
    xs, zs = np.arange(-width, width + _RAY, _RAY), np.arange(-_BEHIND, _BEYOND, _RAY)
    grid = np.stack(np.meshgrid(xs, zs, indexing="ij"), axis=-1).reshape(-1, 2)
    inner = np.full(len(grid), np.inf)
    for corners in side:
        e = _hull(corners).equations
        # along y: normal_y y <= -(normal_x x + normal_z z + offset)
        right = -(grid @ e[:, [0, 2]].T + e[:, 3])
        with np.errstate(divide="ignore", invalid="ignore"):
            at = right / e[:, 1]
        enter = np.where(e[:, 1] < -1e-9, at, -np.inf).max(axis=1)
        leave = np.where(e[:, 1] > 1e-9, at, np.inf).min(axis=1)
        blocked = ((np.abs(e[:, 1]) <= 1e-9) & (right < 0.0)).any(axis=1)
        inner = np.where(~blocked & (enter <= leave), np.minimum(inner, enter), inner)
    pad = grid[np.abs(inner - finger) <= _PAD]
    if not len(pad):
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{where}: no part of a finger is {finger * 1e3:.1f} mm from the middle of the hand, where `fingers` of its"
            " robot.yaml puts the pads",
        )
    # other parts of a finger may be as near to the middle: the pad is what goes on around the TCP
    rows = np.unique(pad[:, 1])
    nearest = int(np.argmin(np.abs(rows)))
    breaks = np.flatnonzero(np.diff(rows) > 1.5 * _RAY) + 1
    part = next(one for one in np.split(rows, breaks) if rows[nearest] in one)
    pad = pad[(pad[:, 1] >= part[0]) & (pad[:, 1] <= part[-1])]
    (x_low, z_low), (x_high, z_high) = pad.min(axis=0), pad.max(axis=0)
    return np.array([x_low, x_high, z_low, z_high])


def _ends(fingers: list[Array]) -> Array:
    """Corners (16, 3) of the boxes about the lowest 20 mm of each finger."""
    corners = np.concatenate(fingers)
    low = corners[corners[:, 2] > corners[:, 2].max() - 0.02]
    boxes: list[Array] = []
    for own in (low[low[:, 1] > 0.0], low[low[:, 1] <= 0.0]):
        least, most = own.min(axis=0), own.max(axis=0)
        boxes.append(0.5 * (least + most) + _box(most - least))
    return np.concatenate(boxes)
