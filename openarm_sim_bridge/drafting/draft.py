# SPDX-License-Identifier: Apache-2.0
"""A draft of a robot's folder from its maker's MJCF or URDF: `openarm model new`. m, rad."""

from __future__ import annotations

import shutil
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from openarm_common.config import load_config, read_text
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Joint, RobotDescription
from openarm_common.robot.meshes import mesh_file
from openarm_common.robot.xml_text import parse_root
from openarm_common.types import Array
from openarm_sim_bridge.drafting.edits import Edits
from openarm_sim_bridge.drafting.mjcf import UrdfDraft, compiled
from openarm_sim_bridge.drafting.semantics import SOURCE, write_srdf

_HEAD = """# SPDX-License-Identifier: Apache-2.0
# Drafted by `openarm model new` from {source}: review it, then ask `openarm model check`.
"""
_LICENCE = "<!-- SPDX-License-Identifier: Apache-2.0 -->\n"


class _Dumper(yaml.SafeDumper):
    """Writes out what is there twice: files of the suite have no aliases."""

    def ignore_aliases(self, data: object) -> bool:
        return True


def draft_folder(
    folder: Path,
    source: Path,
    arms: Mapping[str, tuple[str, str]],
    edits: Path | None = None,
    samples: int = 60_000,
) -> dict[frozenset[str], str]:
    """Write `robot.yaml`, URDF, meshes, `semantics.yaml` and SRDF of a robot.

    Args:
        folder: To make; what it is called is the robot's name.
        source: MJCF (`.xml`) or URDF.
        arms: By name: link that the arm stands on, and link of its tool centre point.
        edits: YAML of `Edits`; with an MJCF only.
        samples: Random states of the collision matrix, unless the folder has a `semantics.yaml` already.

    Returns:
        Why each pair of links in the SRDF may touch.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the folder has a robot, or an arm names a link that the robot does not
            have; CONFIG_INVALID, when a file is faulty.
    """
    if (folder / "robot.yaml").exists():
        text = f"{folder} has a robot; give another name, or take the folder away"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    if not arms:
        raise OpenArmError(Code.INVALID_ARGUMENT, "expected at least one arm, as NAME=BASE_LINK:TIP_LINK")
    wanted = Edits() if edits is None else load_config(edits, Edits)
    folder.mkdir(parents=True, exist_ok=True)
    urdf = folder / f"{folder.name}.urdf"
    if source.suffix == ".xml":
        shared = folder.parent / wanted.meshes if wanted.meshes else None
        if shared is not None and not (shared / "robot.yaml").is_file():
            text = f"{edits}:meshes: there is no robot {wanted.meshes[:80]!r} next to {folder}"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        draft = UrdfDraft(folder.name, compiled(source, wanted), wanted, shared)
        draft.meshes.write(folder, wanted.triangles, wanted.detail)
        urdf.write_text(draft.text().replace("\n", f"\n{_LICENCE}", 1), encoding="utf-8")
    else:
        if edits is not None:
            raise OpenArmError(Code.INVALID_ARGUMENT, "edits are of an MJCF; change the URDF itself")
        urdf.write_text(_adopted(source, folder), encoding="utf-8")
    robot = RobotDescription.from_files(urdf)
    parts = {name: arm_parts(robot, name, base, tip) for name, (base, tip) in arms.items()}
    base = wanted.base if source.suffix == ".xml" else robot.root
    signs = mirror_signs(robot, [part["joints"] for part in parts.values()])
    content = {"urdf": urdf.name, "srdf": f"{folder.name}.srdf", "base": base, "arms": parts, "mirror": signs}
    _write_yaml(folder / "robot.yaml", source, content)
    if not (folder / SOURCE).exists():
        _write_yaml(folder / SOURCE, source, _first_semantics(robot, parts) | {"samples": samples})
    return write_srdf(folder)[1]


def arm_parts(robot: RobotDescription, name: str, base: str, tip: str) -> dict[str, Any]:
    """Return an arm as `robot.yaml` has it; fingers are what moves beyond the arm's last joint.

    Args:
        robot: The robot.
        name: Of the arm.
        base: Link that it stands on.
        tip: Link of its tool centre point.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a link does not exist or no joint is between the two.
    """
    chain, before = robot.chain(tip), {joint.name for joint in robot.chain(base)}
    joints = [joint for joint in chain if joint.name not in before and _leads(joint)]
    if not joints or base not in {robot.root, *(joint.child for joint in chain)}:
        text = f"arm {name!r}: no joint moves {tip!r} against {base!r}; expected the base link, then the tip link"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    flange = joints[-1].child
    beyond = [
        joint
        for joint in robot.joints.values()
        if joint.type != "fixed" and joint not in chain and flange in {joint.parent, *_links_to(robot, joint.parent)}
    ]
    leader = next((joint for joint in beyond if _leads(joint)), None)
    moved = [joint for joint in beyond if leader is not None and leader.name in (joint.name, joint.mimic)]
    return {
        "base": base,
        "joints": [joint.name for joint in joints],
        "flange": flange,
        "hand": leader.parent if leader is not None else chain[-1].parent,
        "tcp": tip,
        "finger_joint": leader.name if leader is not None else "",
        "fingers": [joint.child for joint in moved],
    }


def mirror_signs(robot: RobotDescription, arms: list[list[str]]) -> list[int]:
    """Return the signs that mirror joint positions of one of two arms to the other; none if they are no mirror images.

    A turn about the axis `a` has, with y negated, the image of a turn by the negative angle about the image of `a`.
    """
    if len(arms) != 2 or len(arms[0]) != len(arms[1]):
        return []
    zero = dict.fromkeys(robot.joints, 0.0)
    signs: list[int] = []
    for first, second in zip(*arms, strict=True):
        (T, a), (S, b) = ((_at(robot, robot.joints[joint], zero)) for joint in (first, second))
        if not np.allclose(T * (1.0, -1.0, 1.0), S, atol=1e-4):
            return []
        along = float((a * (1.0, -1.0, 1.0)) @ b)
        if abs(along) < 0.999:
            return []
        slides = robot.joints[first].type == "prismatic"
        signs.append(round(along) if slides else -round(along))
    return signs


def _at(robot: RobotDescription, joint: Joint, state: Mapping[str, float]) -> tuple[Array, Array]:
    """Place and axis (3,) of a joint in the root frame."""
    T = robot.link_pose(joint.child, state)
    return T[:3, 3], T[:3, :3] @ joint.axis


def _leads(joint: Joint) -> bool:
    return joint.type != "fixed" and joint.mimic is None


def _links_to(robot: RobotDescription, link: str) -> set[str]:
    return {joint.child for joint in robot.chain(link)}


def _adopted(source: Path, folder: Path) -> str:
    """URDF text with a name for each shape, and mesh files in its folder; those of packages stay there."""
    root = parse_root(read_text(source), str(source))
    taken = {shape.get("name") for tag in ("visual", "collision") for shape in root.findall(f"link/{tag}")}
    for link in root.findall("link"):
        for tag in ("visual", "collision"):
            for piece, shape in enumerate(link.findall(tag)):
                if shape.get("name") is None:
                    name = f"{link.get('name')}_{piece:02d}_{tag}"
                    shape.set("name", name if name not in taken else f"{name}_{len(taken)}")
    for tag in ("visual", "collision"):
        for mesh in root.findall(f"link/{tag}/geometry/mesh"):
            name = mesh.get("filename", "")
            path = mesh_file(name, source)
            if name.startswith("package://"):
                continue
            target = folder / "meshes" / tag / path.name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
            mesh.set("filename", str(target.relative_to(folder)))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def _first_semantics(robot: RobotDescription, parts: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Postures to begin with: all joints as near to 0 as their limits let them, the fingers at both ends."""
    zero = {
        name: [float(np.clip(0.0, robot.joints[j].lower, robot.joints[j].upper)) for j in arm["joints"]]
        for name, arm in parts.items()
    }
    ends: dict[str, dict[str, float]] = {"open": {}, "closed": {}}
    for name, arm in parts.items():
        if arm["finger_joint"]:
            joint = robot.joints[arm["finger_joint"]]
            closed, opened = sorted((joint.lower, joint.upper), key=abs)
            ends["open"][name], ends["closed"][name] = opened, closed
    touching = [list(arm["fingers"][k : k + 2]) for arm in parts.values() for k in range(len(arm["fingers"]) - 1)]
    gripper = ends if any(ends.values()) else {}
    return {"postures": {"home": zero, "zero": zero}, "gripper": gripper, "may_touch": touching}


def _write_yaml(path: Path, source: Path, content: Mapping[str, Any]) -> None:
    text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, width=120, default_flow_style=None)
    path.write_text(_HEAD.format(source=source.name) + text, encoding="utf-8")
