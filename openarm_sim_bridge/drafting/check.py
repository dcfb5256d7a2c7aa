# SPDX-License-Identifier: Apache-2.0
"""Everything that is wrong with the folder of a robot, at once: `openarm model check`. m, rad."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pinocchio as pin

from openarm_common.collision.self_collision import LinkContacts
from openarm_common.config import read_text
from openarm_common.errors import OpenArmError, said
from openarm_common.robot.description import RobotDescription, part_faults
from openarm_common.robot.folder import RobotFolder, read_folder
from openarm_common.robot.meshes import mesh_file
from openarm_sim_bridge.drafting.collisions import corners_of
from openarm_sim_bridge.drafting.semantics import SOURCE
from openarm_sim_bridge.world.model import import_urdf

#: Longest shape of a link, m.
_LONG = 5.0
#: How far a posture may be outside of a limit, which has fewer digits in other files, rad.
_ROUNDED = 1e-5


def folder_faults(folder: Path) -> list[str]:
    """Return what is wrong with the folder of a robot, a sentence each; nothing when all is well."""
    try:
        parts = read_folder(folder)
    except OpenArmError as error:
        return [error.message]
    urdf = folder / (parts.xacro or parts.urdf)
    try:
        robot = RobotDescription.from_files(urdf, folder / parts.srdf).of_folder(folder.name, parts)
    except OpenArmError as error:
        return list(dict.fromkeys([error.message, *_faults_of_text(urdf)]))
    faults = part_faults(parts, robot)
    if faults:  # what follows looks these parts up
        return [*faults, *_mesh_faults(robot, urdf), *_limit_faults(robot)]
    faults = [
        *_mesh_faults(robot, urdf),
        *_limit_faults(robot),
        *_size_faults(robot),
        *_pad_faults(parts, robot),
        *_group_faults(robot),
    ]
    contacts = LinkContacts(robot)
    always = sorted(map(sorted, contacts.always_touching() - robot.allowed_collisions))
    return [
        *faults,
        *_posture_faults(robot, contacts, folder),
        *(f"{' and '.join(pair)} touch in every random state, and the SRDF does not allow it" for pair in always),
        *_pinocchio_faults(robot),
        *_mujoco_faults(robot, urdf),
    ]


def _faults_of_text(urdf: Path) -> list[str]:
    """What is wrong with a URDF besides the fault that keeps it from being read with its files."""
    try:
        robot = RobotDescription.from_urdf(read_text(urdf))
    except OpenArmError:
        return []
    return [*_mesh_faults(robot, urdf), *_limit_faults(robot)]


def _mesh_faults(robot: RobotDescription, urdf: Path) -> Iterator[str]:
    for mesh in ET.fromstring(robot.urdf).findall("link/*/geometry/mesh"):
        try:
            mesh_file(mesh.get("filename", ""), urdf)
        except OpenArmError as error:
            yield error.message


def _limit_faults(robot: RobotDescription) -> Iterator[str]:
    joints = [joint for joint in robot.joints.values() if joint.type != "fixed" and joint.mimic is None]
    for what in ("velocity", "effort"):
        values = {joint.name: float(getattr(joint, what)) for joint in joints}
        lacking = [name for name, value in values.items() if not math.isfinite(value) or value <= 0.0]
        if lacking:
            given = ", ".join(f"{name} ({values[name]:g})" for name in lacking)
            way = f'for all of them in <limit> of the URDF, or by `{what}: {{"*": NUMBER}}` in --edits of a new draft'
            yield f"joints without a limit of {what} > 0: {given}; give it {way}"
    if still := [joint.name for joint in joints if joint.lower >= joint.upper]:
        way = (
            f"give them in <limit> of the URDF, or by `range: {{{still[0]}: [LOWER, UPPER]}}` in --edits of a new draft"
        )
        yield f"joints without limits, or with one for both, so that they can't move: {', '.join(still)}; {way}"


def _size_faults(robot: RobotDescription) -> Iterator[str]:
    for name, link in robot.links.items():
        if sizes := [
            size for shape in link.collision if (size := float(np.ptp(corners_of(shape), axis=0).max())) > _LONG
        ]:
            way = 'write scale="0.001 0.001 0.001" in its <mesh>'
            yield f"link {name!r} has a shape {max(sizes):.4g} m long; where it is in mm, {way}"


def _pad_faults(parts: RobotFolder, robot: RobotDescription) -> Iterator[str]:
    shapes = {shape.name for link in robot.links.values() for shape in link.collision}
    for name, arm in parts.arms.items():
        for finger in arm.fingers:
            if f"{finger}_pad_collision" not in shapes:
                way = f'give the link a box that grips, <collision name="{finger}_pad_collision">, in the URDF'
                yield f"arms.{name}: finger {finger!r} has no pad; {way}"


def _group_faults(robot: RobotDescription) -> Iterator[str]:
    wanted = [f"{name}_gripper" for name, arm in robot.arms.items() if arm.finger_joint]
    wanted += ["both_arms"] if len(robot.arms) == 2 else []
    yield from (f"the SRDF has no group {group}" for group in wanted if group not in robot.semantics.groups)
    there = set(robot.semantics.states)
    homes = [(f"{arm}_arm", "home") for arm in robot.arms]
    yield from (
        f"the SRDF has no posture {state!r} of {group}" for group, state in homes if (group, state) not in there
    )


def _posture_faults(robot: RobotDescription, contacts: LinkContacts, folder: Path) -> Iterator[str]:
    homes = [robot.semantics.states.get((f"{arm}_arm", "home"), {}) for arm in robot.arms]
    others = {joint: value for home in homes for joint, value in home.items()}
    at_home = contacts.at(others) - robot.allowed_collisions
    touching: dict[tuple[str, ...], list[str]] = {}
    for (group, name), state in robot.semantics.states.items():
        for joint, value in state.items():
            lower, upper = robot.joint(joint).lower, robot.joint(joint).upper
            if not lower - _ROUNDED <= value <= upper + _ROUNDED:
                yield f"posture {name!r} of {group}: {joint} at {value:g}, expected {lower:g} .. {upper:g}"
        found = contacts.at({**others, **state}) - robot.allowed_collisions
        for pair in found - at_home if group.endswith("_gripper") else found:  # arms are at home where a hand moves
            touching.setdefault(tuple(sorted(pair)), []).append(repr(name))
    by_posture: dict[str, list[str]] = {}
    for pair, postures in sorted(touching.items()):
        by_posture.setdefault(", ".join(dict.fromkeys(postures)), []).append(" and ".join(pair))
    way = f"give another one in {SOURCE}, or name pairs whose parts don't touch in may_touch there"
    for postures, pairs in by_posture.items():
        yield f"posture {postures}: {', '.join(pairs)} touch; {way}, then `openarm model semantics {folder}`"


def _pinocchio_faults(robot: RobotDescription) -> Iterator[str]:
    try:
        pin.buildModelFromXML(robot.urdf)
    except ValueError as error:
        yield f"pinocchio does not read the URDF: {said(error)}"


def _mujoco_faults(robot: RobotDescription, urdf: Path) -> Iterator[str]:
    if any(_mesh_faults(robot, urdf)):
        return  # said already
    try:
        import_urdf(robot).compile()
    except (OpenArmError, ValueError) as error:
        yield f"MuJoCo does not read the URDF: {said(error)}"
