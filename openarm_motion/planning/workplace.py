# SPDX-License-Identifier: Apache-2.0
"""Where the arms of a robot grasp from above on a table, and postures of its arms there. Base frame, m, rad."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from itertools import product

import numpy as np

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.hand import HandParts
from openarm_common.robot.work import Region, Table
from openarm_common.types import Array
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.planning.arm import Arm

#: Grid of the places that are tried, and their distance from the edges of the table, m.
_STEP, _EDGE = 0.04, 0.06
#: Cube that is grasped there at each yaw with one of the tilts; straight ways to it and up from it, m.
_CUBE, _BACK, _UP = 0.05, 0.08, 0.12
_YAWS = tuple(math.radians(yaw) for yaw in (0, 45, 90, 135))
_TILTS = tuple(math.radians(tilt) for tilt in (0, 15, -15, 30, -30))
#: Kept from joint limits, rad.
_MARGIN = 0.02
#: Largest region, which a camera over the table sees, m: along x, and |y|; least |y| of robots with two arms.
_LONG, _WIDE, _ASIDE = 0.36, 0.42, 0.06
#: Of postures: hands over the table, m; so far from the shoulder along x when at home, and leans then, rad.
_OVER, _HEIGHTS, _AHEAD, _LEANS = (
    (0.22, 0.17, 0.12),
    (0.30, 0.40, 0.50, 0.65),
    (0.0, 0.1, 0.2, 0.3, 0.4),
    (0.0, 0.8, 1.6),
)
#: What hides this much around the region hides it, m.
_AROUND = 0.06


def reached(arm: Arm, scene: CollisionScene, T: Array, back: float, up: float, margin: float) -> Array | None:
    """Return a grasp, or the same with the hand turned by half, that an arm gets to straight, and straight up from.

    Args:
        arm: The arm.
        scene: Its surroundings.
        T: (4, 4) of the tool.
        back: Way to the grasp, m.
        up: Way up from it, m.
        margin: Kept from joint limits, rad.

    Returns:
        (4, 4); None: it does not get there.
    """
    for flip in (0.0, math.pi):
        pose = T @ se3.make(se3.rot_z(flip))
        before, above = pose.copy(), pose.copy()
        before[:3, 3] -= back * pose[:3, 2]
        above[2, 3] += up
        for solution in arm.inverse.solutions(pose, margin):
            if scene.collides(solution.q):
                continue
            ways = [arm.inverse.follow(np.stack([pose, to]), solution, 0.0, math.pi) for to in (before, above)]
            if all(done == 2 and not scene.collides(path[1]) for path, done, _ in ways):
                return pose
    return None


def grasp_region(arms: Mapping[str, Arm], table: Table, state: Mapping[str, float]) -> Region:
    """Return the largest rectangle in which each arm grasps, on its side, a cube of any yaw, tilted by 30° at most.

    Args:
        arms: Arms, with the table; an arm that is alone grasps on both sides.
        table: Table that objects stand on.
        state: State of the joints; arms that don't move stay there.

    Raises:
        OpenArmError: UNREACHABLE, when there is none.
    """
    xs = np.arange(table.x[0] + _EDGE, table.x[1] - _EDGE + 1e-9, _STEP)
    ys = np.arange(0.0 if len(arms) == 1 else _ASIDE, min(_WIDE, table.y[1] - _EDGE) + 1e-9, _STEP)
    free = np.ones((len(xs), len(ys)), np.bool_)
    for arm in arms.values():
        scene, sides = arm.scene(state, straight=True, gripper=arm.opened), _sides(arm, arms)
        hand = arm.description.hand(arm.name).parts
        for (i, x), (j, y) in product(enumerate(xs), enumerate(ys)):
            if free[i, j]:  # for the arms before
                free[i, j] = all(_grasps_at(arm, scene, hand, (x, side * y), table.top_z) for side in sides)
    corners = [
        (xs[b] - xs[a], ys[d] - ys[c], a, b, c, d)
        for a, b in product(range(len(xs)), repeat=2)
        for c, d in product(range(len(ys)), repeat=2)
        if a < b and c < d and xs[b] - xs[a] <= _LONG and free[a : b + 1, c : d + 1].all()
    ]
    if not corners:
        text = f"no arm grasps from above all over any {_STEP:g} m of the table, {table.top_z:g} m high"
        raise OpenArmError(Code.UNREACHABLE, text)
    _, _, a, b, c, d = max(corners, key=lambda one: one[0] * one[1])
    x, y = (xs[a], xs[b]), (ys[c], ys[d])
    return Region(
        x=(round(float(x[0]), 3), round(float(x[1]), 3)), abs_y=(round(float(y[0]), 3), round(float(y[1]), 3))
    )


def postures(
    arms: Mapping[str, Arm], table: Table, region: Region, eye: Array, state: Mapping[str, float]
) -> dict[str, dict[str, list[float]]]:
    """Return postures by name and arm: `home`, which hides nothing of the region, and `over_table`.

    Args:
        arms: Arms, with the table.
        table: Under the hands.
        region: Region of objects.
        eye: (3,) of the camera that sees them.
        state: State of the joints that no arm has, such as fingers.

    Raises:
        OpenArmError: UNREACHABLE, when an arm has no free posture over the table.
    """
    found: dict[str, dict[str, list[float]]] = {"home": {}, "over_table": {}}
    for arm in arms.values():
        scene = arm.scene(state, gripper=arm.opened)
        side = float(np.sum(_sides(arm, arms)))
        middle = (sum(region.x) / 2.0, side * sum(region.abs_y) / 2.0)
        ways = ((up, tilts) for up in _OVER for tilts in (_TILTS[:1], _TILTS[1:]))
        tries = (
            _free(arm, scene, (se3.make(_down(*turns), (*middle, table.top_z + up)) for turns in product(_YAWS, tilts)))
            for up, tilts in ways
        )
        over = next(filter(None, tries), [])
        shoulder = _shoulder(arm.description, arm.name)
        places = product(_LEANS, _HEIGHTS, _AHEAD)
        points = [
            (lean, np.array([shoulder[0] + ahead, shoulder[1] + 0.1 * side, table.top_z + height]))
            for lean, height, ahead in places
        ]
        homes = _free(arm, scene, (se3.make(_down(math.pi / 2.0, -lean), p) for lean, p in points))
        if not over or not homes:
            raise OpenArmError(Code.UNREACHABLE, f"arm {arm.name!r} has no free posture over the table")
        middle_q = 0.5 * (np.maximum(arm.lower, -math.pi) + np.minimum(arm.upper, math.pi))
        ready = min(over, key=lambda q: float(np.abs(q - middle_q).max()))
        hidden = [_hidden(arm, q, state, table.top_z, region, eye) for q in homes]
        home = min(zip(hidden, homes, strict=True), key=lambda one: (one[0], float(np.abs(one[1] - ready).max())))[1]
        found["home"][arm.name] = home.round(4).tolist()
        found["over_table"][arm.name] = ready.round(4).tolist()
    return found


def _sides(arm: Arm, arms: Mapping[str, Arm]) -> tuple[float, ...]:
    """Signs of y where an arm grasps: of several, that of its shoulder."""
    if len(arms) == 1:
        return (1.0, -1.0)
    robot = arm.description
    return (math.copysign(1.0, _shoulder(robot, arm.name)[1]),)


def _shoulder(robot: RobotDescription, arm: str) -> Array:
    """Place (3,) of the first link that an arm moves."""
    moved = robot.joint(robot.arm_joints(arm)[0]).child
    return robot.link_pose(moved, dict.fromkeys(robot.joints, 0.0))[:3, 3]


def _down(yaw: float, tilt: float) -> Array:
    """Rotation (3, 3) of a hand that points down, closes along `yaw` and leans about that."""
    y = se3.rot_z(yaw)[:, 0]
    heading = np.cross((0.0, 0.0, 1.0), y)
    return se3.rotation_from_z_y(math.sin(tilt) * heading - math.cos(tilt) * np.array([0.0, 0.0, 1.0]), y)


def _grasps_at(arm: Arm, scene: CollisionScene, hand: HandParts, xy: tuple[float, float], top_z: float) -> bool:
    return all(any(_grasp(arm, scene, hand, xy, top_z, yaw, tilt) for tilt in _TILTS) for yaw in _YAWS)


def _grasp(
    arm: Arm, scene: CollisionScene, hand: HandParts, xy: tuple[float, float], top_z: float, yaw: float, tilt: float
) -> bool:
    height = max(hand.tip_clearance + hand.tip_clearance_tilted * math.sin(abs(tilt)), _CUBE / 2.0 - hand.pad_centre)
    T = se3.make(_down(yaw, tilt), (*xy, top_z + height))
    T[:3, 3] -= hand.tcp_shift(_CUBE / 2.0) * T[:3, 2]
    return reached(arm, scene, T, _BACK, _UP, _MARGIN) is not None


def _free(arm: Arm, scene: CollisionScene, poses: Iterator[Array]) -> list[Array]:
    """Configurations (n,) at poses that collide with nothing."""
    found = [solution.q for pose in poses for solution in arm.inverse.solutions(pose, 0.1)]
    return [q for q in found if not scene.collides(q)]


def _hidden(arm: Arm, q: Array, state: Mapping[str, float], top_z: float, region: Region, eye: Array) -> int:
    """How many corners of an arm's shapes a camera sees before the region."""
    robot = arm.description
    poses = robot.link_poses({**state, **dict(zip(arm.names, q.tolist(), strict=True))})
    corners: list[Array] = []
    for link in robot.links_of(arm.name):
        for shape in robot.links[link].collision:
            corners.append(se3.apply(poses[link] @ shape.T_link_primitive, shape.points))
    points = np.concatenate([np.zeros((0, 3)), *corners])
    points = points[(points[:, 2] > top_z) & (points[:, 2] < eye[2] - 0.01)]
    seen = eye + (points - eye) * ((eye[2] - top_z) / (eye[2] - points[:, 2]))[:, None]
    before = (seen[:, 0] > region.x[0] - _AROUND) & (seen[:, 0] < region.x[1] + _AROUND)
    return int((before & (np.abs(seen[:, 1]) < region.abs_y[1] + _AROUND)).sum())
