# SPDX-License-Identifier: Apache-2.0
"""What a draft adds to its maker's description: a stand, frames and pads of hands, motors of a simulation. SI units."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.robot.convex import hull_of
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.xml_text import floats
from openarm_common.types import Array
from openarm_sim_bridge.drafting.hand import measured, surface
from openarm_sim_bridge.drafting.mjcf import TENSOR, WORLD, fixed_joint, set_origin, shape_element

#: Edge of the column that is seen under a robot on a stand, m.
_COLUMN = 0.16
#: Density of what has no mass, kg/m3; least mass, kg, and size, m, of it.
_WATER, _LEAST_MASS, _LEAST_SIZE = 1000.0, 0.01, 0.02
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
        turn: Turn of it about z, rad.
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


def lift(robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Return the joint that carries all arms and slides, the last of several; nothing without one."""
    first, *others = [robot.chain(arm["base"]) for arm in parts.values()]
    return [j.name for j in first if j.type == "prismatic" and j.mimic is None and all(j in one for one in others)][-1:]


def fix_undriven(root: ET.Element, robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Fix the joints that neither an arm nor a hand drives, as near to 0 as their limits let them; returns remarks.

    The lift stays.
    """
    driven = {name for arm in parts.values() for name in (*arm["joints"], arm["finger_joint"])} | set(
        lift(robot, parts)
    )
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


def add_masses(root: ET.Element, robot: RobotDescription) -> list[str]:
    """Weigh what moves without a mass, and give what has an inertia that no body has one of its size; returns remarks.

    MuJoCo reads neither. What is weighed is as heavy as water in the shapes that collide.
    """
    elements = {element.get("name", ""): element for element in root.findall("link")}
    given = {name: _mass_of(element) for name, element in elements.items()}
    wrong = [name for name, (_, tensor) in given.items() if tensor.any() and not _is_inertia(tensor)]
    groups = [fixed_to(robot, joint.child) for joint in robot.joints.values() if joint.type != "fixed"]
    light = [
        name
        for group in groups
        if not any(given[one][0] > 0.0 and given[one][1].any() for one in group)
        for name in [one for one in group if robot.links[one].collision] or group[:1]
    ]
    weighed: dict[str, float] = {}
    for name in dict.fromkeys([*wrong, *light]):
        points = np.concatenate([np.zeros((1, 3)), *map(surface, robot.links[name].collision)])
        points = points[1:] if len(points) > 1 else points
        volume = sum(hull_of(surface(shape))[1] for shape in robot.links[name].collision)
        mass = given[name][0]
        if mass <= 0.0:
            mass = weighed[name] = max(_WATER * volume, _LEAST_MASS)
        _set_mass(elements[name], mass, points.min(axis=0), points.max(axis=0))
    remarks: list[str] = []
    if weighed:
        what = f"no mass: {', '.join(weighed)}; taken as heavy as water, {sum(weighed.values()):.3g} kg together"
        remarks.append(f"{what}; where it is known, give it in <inertial> of the URDF")
    if others := [name for name in [*wrong, *light] if name not in weighed]:
        remarks.append(
            f"an inertia that no body has: {', '.join(dict.fromkeys(others))}; taken as that of a box instead"
        )
    return remarks


def _mass_of(link: ET.Element) -> tuple[float, Array]:
    """Mass of a link, kg, and inertia (3, 3), kg m2; 0 where it has none."""
    mass, inertia = link.find("inertial/mass"), link.find("inertial/inertia")
    tensor = np.zeros((3, 3))
    if inertia is not None:
        for key, (i, k) in TENSOR.items():
            tensor[i, k] = tensor[k, i] = floats(inertia.get(key, "0"), 1, inertia)[0]
    return 0.0 if mass is None else floats(mass.get("value", "0"), 1, mass)[0], tensor


def _is_inertia(tensor: Array) -> bool:
    """Whether moments are above 0, and none is larger than the two others together."""
    a, b, c = np.linalg.eigvalsh(tensor)
    return bool(a > 0.0 and a + b >= c)


def _set_mass(link: ET.Element, mass: float, low: Array, high: Array) -> None:
    """Give a link the mass and inertia of a box."""
    for element in link.findall("inertial"):
        link.remove(element)
    inertial = ET.SubElement(link, "inertial")
    set_origin(inertial, se3.make(p=0.5 * (low + high)))
    x, y, z = np.maximum(high - low, _LEAST_SIZE) ** 2
    moments = mass / 12.0 * np.diag([y + z, x + z, x + y])
    ET.SubElement(inertial, "mass", value=f"{mass:.6g}")
    ET.SubElement(inertial, "inertia", {key: f"{moments[at]:.6g}" for key, at in TENSOR.items()})


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


def fixed_to(robot: RobotDescription, link: str) -> list[str]:
    """Return a link and those that are fixed to it, directly or by others."""
    found = [link]
    for name in found:
        found += [joint.child for joint in robot.joints.values() if joint.type == "fixed" and joint.parent == name]
    return found


def _known(limit: float, otherwise: float) -> float:
    return limit if 0.0 < limit < math.inf else otherwise


def _row(factor: float, values: Array | list[float]) -> list[float]:
    return [float(f"{factor * value:.3g}") for value in values]


def _free_name(name: str, robot: RobotDescription) -> str:
    return name if name not in robot.links else _free_name(f"{name}_", robot)
