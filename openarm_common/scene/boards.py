# SPDX-License-Identifier: Apache-2.0
"""Where a calibration board is for each camera of a robot; it follows from the robot's folder. Base frame = world, m.

For a fixed camera an arm holds it ahead of its fingers; for one that moves it lies on the table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras, near_camera, table_camera, uncertain_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.types import Array

#: Begins the name of the scene with the board of a camera.
CALIBRATION = "calibration"
_MODEL = "boards/circles_4x11.xml"
#: The board in the hand, so far ahead of the tool centre point, m.
_AHEAD, _HELD = 0.19, se3.rotation_from_z_y((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
#: And on the table: before the far end of the region, to the side of the arm, m.
_BEFORE, _ASIDE, _ABOVE = 0.03, 0.2, 0.005
_LYING = ((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
#: Edges of what carries the marks, as in the model, m.
_PLATE = (0.18, 0.24, 0.003)
#: The board in a posture to begin in keeps this from all else, m; postures tried, the last ones so far from home, rad.
_ROOM, _TRIES, _AWAY = 0.015, 4000, 1.5
#: An arm whose shoulder is nearer to the middle is of neither side, m.
_MIDDLE = 0.02


class Place(NamedTuple):
    """A board for a camera.

    Args:
        camera: Camera that sees it.
        arm: Arm that holds it, for a fixed camera; "": it lies on the table.
    """

    camera: CameraConfig
    arm: str

    @property
    def scene(self) -> str:
        """Name of the scene with the board; the last arm is not named."""
        last = self.arm in ("", RobotDescription.load().arm_names[-1])
        return f"{CALIBRATION}_{self.camera.name}" + ("" if last else f"_{self.arm}_arm")


def board_places(cameras: Sequence[str], *, every_arm: bool = True) -> tuple[Place, ...]:
    """Return where a board is needed to calibrate cameras: in each arm's hand for a fixed one, the last arm's first.

    Args:
        cameras: Names.
        every_arm: Whether every arm is to hold it, not the last one alone.
    """
    known, description = load_cameras(), RobotDescription.load()
    arms = description.arm_names[::-1] if every_arm else description.arm_names[-1:]
    return tuple(
        Place(known[name], arm)
        for name in cameras
        for arm in (("",) if description.arm_of(known[name].parent) else arms)
    )


def board_scenes() -> dict[str, Place]:
    """Return the boards for the cameras of this process's robot by the names of their scenes.

    `calibration` is for the camera that is calibrated when none is named.
    """
    scenes = {place.scene: place for place in board_places(uncertain_cameras())}
    first = scenes.get(f"{CALIBRATION}_{near_camera() or table_camera()}")
    return scenes | ({} if first is None else {CALIBRATION: first})


def board_of(camera: CameraConfig, description: RobotDescription, arm: str = "") -> tuple[str, Array]:
    """Return the link that carries the board for a camera ("": the world), and its pose in the frame of it, (4, 4).

    Args:
        camera: Camera that sees it.
        description: The robot.
        arm: Arm that holds it, for a fixed camera; "": the last one.
    """
    anyhow = dict.fromkeys(description.joints, 0.0)
    moves = description.arm_of(camera.parent)
    if not moves:
        holder = description.arm(arm or description.arm_names[-1])
        flange, tcp = (description.link_pose(link, anyhow) for link in (holder.flange, holder.tcp))
        T_flange_tcp = se3.inverse(flange) @ tcp
        T_flange_board = T_flange_tcp @ se3.make(_HELD, (0.0, 0.0, _AHEAD))
        return holder.flange, se3.make(T_flange_board[:3, :3], T_flange_board[:3, 3].round(3))
    work = robot_work()
    shoulder = float(description.link_pose(description.arm(moves).base, anyhow)[1, 3])
    y = float(np.sign(shoulder)) * _ASIDE if abs(shoulder) > _MIDDLE else 0.0
    place = (round(work.region.x[1] - _BEFORE, 3), y, round(work.table.top_z + _ABOVE, 3))
    return "", se3.make(se3.rotation_from_z_y(*_LYING), place)


def board_start(place: Place) -> dict[str, float]:
    """Return where the joints are when a calibration begins, rad or m: hands open, and the board clear of everything.

    The arm that holds the board is at home, or as near to it as a posture is found; open fingers hide less.

    Raises:
        OpenArmError: NO_PLAN, when no posture near home is clear.
    """
    description = RobotDescription.load()
    start = {hand.joint: hand.opened for hand in description.hands.values()}
    link, T_link_board = board_of(place.camera, description, place.arm)
    if not link:
        return start
    from openarm_common.collision.self_collision import SelfCollision

    lift = description.lift
    whole = start | ({} if lift is None else {lift.joint: lift.home})
    for arm in description.arm_names:
        whole |= description.group_state(f"{arm}_arm", "home")
    table = robot_work().table
    low, high = np.array([table.x[0], table.y[0], table.top_z - table.thickness]), [table.x[1], table.y[1], table.top_z]
    top = Primitive("table", "box", tuple(np.subtract(high, low).tolist()), se3.make(None, np.add(low, high) / 2.0))
    roomy = tuple(edge + 2.0 * _ROOM for edge in _PLATE)
    board = Primitive("board", "box", roomy, T_link_board @ se3.make(None, (0.0, 0.0, _PLATE[2] / 2.0)))
    links = dict(description.links)
    for carrier, shape in ((link, board), (description.root, top)):
        links[carrier] = replace(links[carrier], collision=(*links[carrier].collision, shape))
    robot = SelfCollision(replace(description, links=MappingProxyType(links)), tuple(whole))
    moved = description.arm_joints(description.arm_of(link))
    home, (lower, upper) = np.array([whole[name] for name in moved]), description.limits(moved)
    rng = np.random.default_rng(0)
    for away in np.linspace(0.0, _AWAY, _TRIES):
        q = np.clip(home + rng.uniform(-away, away, len(home)), lower, upper)
        there = whole | dict(zip(moved, q.tolist(), strict=True))
        if robot.nearest(robot.distances(np.array([*there.values()]))).distance > 0.0:
            return start | ({} if away == 0.0 else {name: there[name] for name in moved})
    raise OpenArmError(
        Code.NO_PLAN,
        f"of {_TRIES} postures near home none keeps the board on {link!r} {_ROOM * 1e3:.0f} mm from robot and table;"
        " calibrate with another board or carrier (calibration.carrier), from a posture of your own (--running)",
    )


def board_scene(place: Place) -> dict[str, Any]:
    """Return the scene with a board, as a file would say it."""
    link, T_link_board = board_of(place.camera, RobotDescription.load(), place.arm)
    axes = {name: T_link_board[:3, k].tolist() for name, k in (("position", 3), ("z_axis", 2), ("y_axis", 1))}
    return {"objects": [], "fixtures": [{"name": "board", "model": _MODEL, "link": link, **axes}]}
