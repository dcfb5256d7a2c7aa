# SPDX-License-Identifier: Apache-2.0
"""What a draft adds to its maker's description: a stand, frames and pads of hands, motors of a simulation. SI units."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_sim_bridge.drafting.hand import measured
from openarm_sim_bridge.drafting.mjcf import WORLD, fixed_joint, set_origin, shape_element

#: Edge of the column that is seen under a robot on a stand, m.
_COLUMN = 0.16
#: Fastest plans, rad/s; acceleration and jerk are so many times that.
_SPEED, _ACCELERATION, _JERK = 2.0, 3.0, 30.0
#: Of a joint without a limit, N m; gain for each N m that it can do, and damping for each of that; kg m2 for each.
_EFFORT, _STIFFNESS, _DAMPING, _ARMATURE = 50.0, 50.0, 0.1, 1e-3


def add_stand(
    root: ET.Element, robot: RobotDescription, base: str, place: tuple[float, float, float], turn: float
) -> None:
    """Put the robot of a URDF on a stand that is seen and touches nothing, as a draft from an MJCF is.

    The root link is then `world`, the name of MuJoCo's; what was on that is on the stand.

    Args:
        root: Root element of the URDF.
        robot: The same, read.
        base: Link to add, on the floor.
        place: Place of the robot, in the frame of the base.
        turn: Of it about z, rad.
    """
    T = se3.make(se3.rot_z(turn), place)
    if robot.root != WORLD:
        ET.SubElement(root, "link", name=WORLD)
        fixed_joint(root, f"{robot.root}_fixed", base, robot.root, T)
    for element in root.findall("joint"):
        parent = element.find("parent")
        if robot.root == WORLD and parent is not None and parent.get("link") == WORLD:
            parent.set("link", base)
            for origin in element.findall("origin"):
                element.remove(origin)
            set_origin(element, T @ robot.joints[element.get("name", "")].T_parent_joint)
    link = ET.SubElement(root, "link", name=base)
    fixed_joint(root, f"{base}_fixed", WORLD, base, np.eye(4))
    if place[2] > 0.0:
        middle = se3.make(p=(place[0], place[1], 0.5 * place[2]))
        shape_element(link, "visual", f"{base}_column_visual", middle, "box", size=f"{_COLUMN} {_COLUMN} {place[2]:g}")


def add_hands(
    root: ET.Element, robot: RobotDescription, parts: Mapping[str, dict[str, Any]]
) -> tuple[dict[str, Any], list[str]]:
    """Add tool centre points and pads to a URDF, and both to the arms; returns `hand` of `robot.yaml`, and remarks."""
    found: dict[str, dict[str, Any]] = {}
    remarks: list[str] = []
    for name, arm in parts.items():
        hand = measured(robot, arm) if arm["finger_joint"] else None
        if hand is None:
            if arm["finger_joint"]:
                what = f"arms.{name}: no two fingers that come together, so robot.yaml has no `hand`"
                remarks.append(f"{what}; write it as docs/extending.md says")
            continue
        if hand.T_tip_tcp is not None:
            tip, arm["tcp"] = arm["tcp"], _free_name(f"{name}_tcp", robot)
            ET.SubElement(root, "link", name=arm["tcp"])
            fixed_joint(root, f"{arm['tcp']}_fixed", tip, arm["tcp"], hand.T_tip_tcp)
            what = (
                f"arms.{name}: {tip!r} is not between the pads with z out of the fingers and y their opening direction"
            )
            remarks.append(f"{what}; {arm['tcp']!r}, which is, has been added")
        if hand.sign < 0:
            arm["finger_sign"] = -1
        for link, (T, size) in hand.pads.items():
            element = next(one for one in root.findall("link") if one.get("name") == link)
            edges = " ".join(f"{edge:.5g}" for edge in size)
            shape_element(element, "collision", f"{link}_pad_collision", T, "box", size=edges)
        found[name] = hand.parts
    first = next(iter(found.values()), None)
    if first is None:
        return {}, remarks
    for name, hand_parts in found.items():
        if not np.allclose(hand_parts["opening"], first["opening"], atol=2e-3):
            opens = f"opens to {hand_parts['opening']:g} m, that of robot.yaml to {first['opening']:g} m"
            remarks.append(f"arms.{name}: its hand {opens}; hands of a robot are expected to be alike")
    return {"hand": first}, remarks


def fix_undriven(root: ET.Element, robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Fix the joints that neither an arm nor a hand drives, as near to 0 as their limits let them; returns remarks.

    What slides below all arms stays, for it may be a lift.
    """
    driven = {name for arm in parts.values() for name in (*arm["joints"], arm["finger_joint"])}
    below = [{joint.name for joint in robot.chain(arm["base"])} for arm in parts.values()]
    driven |= {name for name in set.intersection(*below) if robot.joints[name].type == "prismatic"}
    moving = [joint for joint in robot.joints.values() if joint.type != "fixed"]
    loose = {joint.name: joint for joint in moving if not driven & {joint.name, joint.mimic}}
    zero = {name: float(np.clip(0.0, joint.lower, joint.upper)) for name, joint in robot.joints.items()}
    for element in root.findall("joint"):
        joint = loose.get(element.get("name", ""))
        if joint is None:
            continue
        q = zero[joint.name] if joint.mimic is None else joint.multiplier * zero[joint.mimic] + joint.offset
        for part in [one for one in element if one.tag not in ("parent", "child")]:
            element.remove(part)
        element.set("type", "fixed")
        set_origin(element, joint.T_parent_joint @ joint.motion(q))
    return [f"fixed at 0, since no arm and no hand drives them: {', '.join(loose)}"] if loose else []


def drives(robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return `motion` and `motors` of `robot.yaml`: servos that carry the arms, as strong as the limits of the joints.

    None where the arms have different numbers of joints.
    """
    limits = [[robot.joints[joint] for joint in arm["joints"]] for arm in parts.values()]
    if len({len(arm) for arm in limits}) > 1:
        return {}
    velocity = [min(_known(joint.velocity, _SPEED) for joint in joints) for joints in zip(*limits, strict=True)]
    effort = [min(_known(joint.effort, _EFFORT) for joint in joints) for joints in zip(*limits, strict=True)]
    speed = np.minimum(velocity, _SPEED)
    gains = {"stiffness": _row(_STIFFNESS, effort), "damping": _row(_STIFFNESS * _DAMPING, effort)}
    motion = {"velocity": _row(1.0, speed), "acceleration": _row(_ACCELERATION, speed), "jerk": _row(_JERK, speed)}
    motors = {"gains": gains, "stiff": gains, "armature": _row(_ARMATURE, effort), "gravity_compensation": 1.0}
    return {"motion": motion, "motors": motors}


def _known(limit: float, otherwise: float) -> float:
    return limit if 0.0 < limit < math.inf else otherwise


def _row(factor: float, values: Array | list[float]) -> list[float]:
    return [float(f"{factor * value:.3g}") for value in values]


def _free_name(name: str, robot: RobotDescription) -> str:
    return name if name not in robot.links else _free_name(f"{name}_", robot)
