# SPDX-License-Identifier: Apache-2.0
"""The table, the cameras and the postures of a robot that is new, written into its folder. Base frame, m, rad."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.config import load_yaml, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import read_folder
from openarm_common.robot.work import Region, Table
from openarm_motion.config import MotionConfig
from openarm_motion.planning.workplace import grasp_region, postures
from openarm_motion.service.motion_service import make_arms, table_box
from openarm_sim_bridge.drafting.draft import write_yaml, yaml_text
from openarm_sim_bridge.drafting.hand import reach_of_hand, surface
from openarm_sim_bridge.drafting.semantics import SOURCE, rewrite_states

#: Table before a robot: as high as its arms stand, within such heights; room before the robot, size, thickness, m.
_HEIGHTS, _ROOM, _DEPTH, _HALF, _THICKNESS = (0.05, 1.2), 0.02, 0.70, 0.60, 0.04
#: Of the camera over the table from the middle of the region, its direction; the same of that for people, m.
_EYE, _DOWN = (0.37, 0.0, 0.75), (-0.35, 0.0, -0.75)
_PEOPLE, _LOOK = (0.97, -0.95, 0.70), (-1.05, 0.85, -0.50)
#: Half of the width of the region in the middle where objects change hands, and what is off each end of it, m.
_STRIP, _END = 0.03, 0.04


def find_workplace(folder: Path) -> str:
    """Find where a robot grasps on its table, and write `work`, cameras and postures into its folder.

    A table that `robot.yaml` has stays, and so do cameras and postures that a draft does not have.

    Returns:
        A sentence: where objects stand, or what keeps the arms from grasping there.
    """
    parts = read_folder(folder)
    urdf = folder / (parts.xacro or parts.urdf)
    robot = RobotDescription.from_files(urdf, folder / parts.srdf).of_folder(folder.name, parts)
    if not any(arm.finger_joint for arm in robot.arms.values()):
        return "work: not looked for, since no arm has a hand: it is planned for alone"
    if not robot.hands or robot.motion is None:
        lacking = "hand" if not robot.hands else "motion"
        return f"work: needs `{lacking}` in robot.yaml, then `openarm model work {folder}`"
    zero = {name: float(np.clip(0.0, joint.lower, joint.upper)) for name, joint in robot.joints.items()}
    front = _front(robot, zero)
    table = _table(robot, zero, front) if parts.work is None else parts.work.table
    try:
        arms = make_arms(MotionConfig(), robot, (table_box(table),), {})
        region = grasp_region(arms, table, zero)
        eye = np.array([sum(region.x) / 2.0, 0.0, table.top_z]) + _EYE
        found = postures(arms, table, region, eye, zero)
    except OpenArmError as error:
        way = "; `stand: [X, Y, Z]` in --edits of a new draft puts the robot higher or farther back"
        return f"work: {error.message}{way if error.code is Code.UNREACHABLE else ''}"
    _write(folder, robot, table, region, round(front, 3), found)
    where = "x {:g} .. {:g}, |y| {:g} .. {:g} m".format(*region.x, *region.abs_y)
    return f"work: objects stand at {where}, where the arms were found to grasp from above"


def _front(robot: RobotDescription, state: dict[str, float]) -> float:
    """Greatest x of what no arm moves."""
    poses = robot.link_poses(state)
    moved = {robot.joint(joint).child for arm in robot.arm_names for joint in robot.arm_joints(arm)}
    fixed = [link for link in robot.links if not moved & {link, *(joint.child for joint in robot.chain(link))}]
    shapes = [(poses[link], shape) for link in fixed for shape in robot.links[link].collision]
    return max((float(se3.apply(T, surface(shape))[:, 0].max()) for T, shape in shapes), default=0.0)


def _table(robot: RobotDescription, state: dict[str, float], front: float) -> Table:
    """A table as high as the lowest arm stands."""
    poses = robot.link_poses(state)
    height = min(float(poses[arm.base][2, 3]) for arm in robot.arms.values())
    x = (round(front + _ROOM, 3), round(front + _ROOM + _DEPTH, 3))
    top_z = round(float(np.clip(height, *_HEIGHTS)), 3)
    return Table(top_z=top_z, x=x, y=(-_HALF, _HALF), thickness=_THICKNESS)


def _write(
    folder: Path,
    robot: RobotDescription,
    table: Table,
    region: Region,
    least_x: float,
    found: dict[str, dict[str, list[float]]],
) -> None:
    work: dict[str, Any] = {
        "table": table.model_dump(mode="json"),
        "least_x": least_x,
        "region": region.model_dump(mode="json"),
    }
    if len(robot.arms) == 2:
        work["hand_over"] = {"x": [region.x[0] + _END, region.x[1] - _END], "abs_y": _STRIP}
    path = folder / "robot.yaml"
    text = re.sub(r"^work:.*?(?=^\S|\Z)", "", read_text(path), flags=re.MULTILINE | re.DOTALL)
    if not load_yaml(path).get("cameras"):
        write_yaml(folder / "cameras.yaml", {"cameras": _cameras(robot, table, region)})
        text += "cameras: cameras.yaml\n"
    path.write_text(text + yaml_text({"work": work}), encoding="utf-8")
    said = load_yaml(folder / SOURCE)
    if said.get("postures", {}).keys() <= {"home", "zero"}:
        shown = {"home": found["home"], "over_table": found["over_table"], "wrist_look": found["over_table"]}
        write_yaml(folder / SOURCE, {**said, "postures": {**said["postures"], **shown}})
        rewrite_states(folder)


def _cameras(robot: RobotDescription, table: Table, region: Region) -> list[dict[str, Any]]:
    """A camera over the table, one on the last hand, and one for people."""
    middle = np.array([sum(region.x) / 2.0, 0.0, table.top_z])
    arm = robot.arm_names[-1]
    aside, back = reach_of_hand(robot, arm)
    wrist = np.array([aside + 0.03, 0.0, -back])
    return [
        {
            "name": "overhead",
            "parent": robot.base,
            "position": (middle + _EYE).round(3).tolist(),
            "forward": list(_DOWN),
            "image_right": [0.0, 1.0, 0.0],
            "near": 0.2,
            "far": 3.0,
            "housing": [0.025, 0.09, 0.025],
        },
        {
            "name": "wrist",
            "parent": robot.tcp_link(arm),
            "position": wrist.round(3).tolist(),
            "forward": (np.array([0.0, 0.0, 0.10]) - wrist).round(3).tolist(),
            "image_right": [0.0, -1.0, 0.0],
            "near": 0.07,
            "far": 2.0,
            "housing": [0.03, 0.10, 0.03],
        },
        {
            "name": "spectator",
            "parent": robot.base,
            "position": (middle + _PEOPLE).round(3).tolist(),
            "forward": list(_LOOK),
            "image_right": [0.66, 0.86, 0.0],
            "fovy_deg": 45.0,
            "rate": 15.0,
            "far": 5.0,
            "depth": False,
            "mount_error": False,
        },
    ]
