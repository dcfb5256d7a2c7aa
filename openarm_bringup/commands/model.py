# SPDX-License-Identifier: Apache-2.0
"""`openarm model`: the robot description in the form that another tool reads, and folders of further robots."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from cyclopts import App

from openarm_bringup.commands.connect import Robot
from openarm_bringup.outcome import Outcome
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import choose_robot, robot_folder, robot_name

model = App(name="model", help="Write the robot for other tools; draft and check the folder of a robot.")


@model.default
def write(
    kind: Literal["urdf", "mjcf", "srdf"],
    *,
    out: Path | None = None,
    render: Path | None = None,
    scene: str | None = None,
    seed: int = 0,
    view: str = "three_quarter",
    robot: Robot = None,
) -> Outcome:
    """Write the robot as URDF, MJCF or SRDF, or a picture of it.

    Args:
        kind: urdf (expanded), mjcf (as MuJoCo reads it) or srdf.
        out: File to write, in which meshes are named from its folder; without one, the text is printed.
        render: PNG file for a picture of the robot in a scene.
        scene: mjcf and picture: name or path of a scene to put around the robot, or "random".
        seed: Seed of a random scene.
        view: View of the picture: front, three_quarter, side, back, top, or the name of a camera.
    """
    choose_robot(robot)
    from openarm_sim_bridge.world.export import export, render_png

    text = export(kind, scene if kind == "mjcf" else None, seed, out.parent if out is not None else None)
    written: list[str] = []
    if render is not None:
        render_png(render, scene or "demo", view=view, seed=seed)
        written.append(str(render))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(text, encoding="utf-8")
        written.append(str(out))
    data = {"kind": kind, "robot": robot_name(), "scene": scene, "written": written}
    if written:
        return Outcome(True, f"wrote {', '.join(written)}", data=data)
    return Outcome(True, data={**data, "text": text}, text=text)


@model.command
def new(
    name: str,
    *,
    mjcf: Path | None = None,
    urdf: Path | None = None,
    arm: tuple[str, ...] = (),
    edits: Path | None = None,
    samples: int = 60_000,
    out: Path | None = None,
    arg: tuple[str, ...] = (),
    package: tuple[str, ...] = (),
) -> Outcome:
    """Draft the folder of a robot, `models/robots/NAME`, from its maker's MJCF or URDF.

    Args:
        name: Name of the robot.
        mjcf: The maker's MJCF.
        urdf: The maker's URDF or xacro (`.xacro`), in place of an MJCF.
        arm: NAME=BASE_LINK:TIP_LINK of an arm: what it stands on, and its tool centre point; may be repeated.
        edits: YAML of what the MJCF lacks: velocity limits, boxes, pads, frames; of a URDF, limits and
            couplings of joints, hulls, and where it stands.
        samples: Random states of the collision matrix.
        out: Folder in which the robot's folder is made; without one, `models/robots`.
        arg: NAME:=VALUE of an argument of the xacro; may be repeated.
        package: NAME=FOLDER of a package that `package://NAME` or `$(find NAME)` means, where it is neither above the
            file nor installed; may be repeated.
    """
    from openarm_bringup.workplace import find_workplace
    from openarm_common.resources import models_dir
    from openarm_sim_bridge.drafting.check import folder_faults
    from openarm_sim_bridge.drafting.draft import draft_folder

    if (mjcf is None) == (urdf is None):
        raise OpenArmError(Code.INVALID_ARGUMENT, "expected one of --mjcf and --urdf")
    if not name.isidentifier():
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{name!r} names no robot, expected letters, digits and _")
    folder = (models_dir() / "robots" if out is None else out) / name
    source = mjcf or urdf or Path()
    arguments = dict(_pair("--arg", text, ":=", "NAME:=VALUE") for text in arg)
    packages = {key: Path(at) for key, at in (_pair("--package", text, "=", "NAME=FOLDER") for text in package)}
    draft = draft_folder(folder, source, dict(map(_arm, arm)), edits, samples, arguments, packages)
    remarks = [*draft.remarks, find_workplace(folder)]
    always = sorted(" and ".join(sorted(pair)) for pair, reason in draft.reasons.items() if reason == "Always")
    faults = folder_faults(folder)
    data = {"folder": str(folder), "always_touching": always, "remarks": remarks, "faults": faults}
    lines = [f"note: {remark}" for remark in remarks]
    lines += [f"allowed, since they touch in every random state: {pair}" for pair in always]
    text = "\n".join([*lines, *(f"to do: {fault}" for fault in faults)])
    return Outcome(True, f"drafted {folder}: {len(faults)} to do", data=data, text=text)


@model.command
def semantics(name: str) -> Outcome:
    """Write the SRDF of a robot from its `semantics.yaml`, with a sampled collision matrix; takes minutes.

    Args:
        name: Name of the robot, or the path of its folder.
    """
    from openarm_sim_bridge.drafting.semantics import write_srdf

    choose_robot(name)
    path, reasons = write_srdf(robot_folder())
    count = {reason: list(reasons.values()).count(reason) for reason in sorted(set(reasons.values()))}
    always = sorted(" and ".join(sorted(pair)) for pair, reason in reasons.items() if reason == "Always")
    text = "\n".join(f"allowed, since they touch in every random state: {pair}" for pair in always)
    what = ", ".join(f"{number} {reason}" for reason, number in count.items())
    return Outcome(True, f"wrote {path}: {what}", data={"path": str(path), "pairs": count}, text=text)


@model.command
def work(name: str) -> Outcome:
    """Find where a robot grasps on its table; write that, and the cameras and postures that a draft lacks.

    Args:
        name: Name of the robot, or the path of its folder.
    """
    from openarm_bringup.workplace import find_workplace

    choose_robot(name)
    message = find_workplace(robot_folder())
    return Outcome(True, message, data={"work": message})


@model.command
def check(name: str) -> Outcome:
    """Say everything that is wrong with the folder of a robot: parts, meshes, limits, postures, contacts, MuJoCo.

    Args:
        name: Name of the robot, or the path of its folder.
    """
    from openarm_sim_bridge.drafting.check import folder_faults

    choose_robot(name)
    faults = folder_faults(robot_folder())
    if faults:
        text = "\n".join(faults)
        message = f"{name}: {len(faults)} {'fault' if len(faults) == 1 else 'faults'}"
        return Outcome(False, message, Code.CONFIG_INVALID, {"faults": faults}, text)
    return Outcome(True, f"{name}: nothing is wrong", data={"faults": []})


def _pair(option: str, text: str, sign: str, form: str) -> tuple[str, str]:
    """Read a name and a value, with a sign between them."""
    name, found, value = text.partition(sign)
    if not (name and found):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{option} {text!r}: expected {form}")
    return name, value


def _arm(text: str) -> tuple[str, tuple[str, str]]:
    """Read NAME=BASE_LINK:TIP_LINK."""
    name, _, links = text.partition("=")
    base, _, tip = links.partition(":")
    if not (name.isidentifier() and base and tip):
        what = "expected NAME=BASE_LINK:TIP_LINK, with a name of letters, digits and _"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"--arm {text!r}: {what}")
    return name, (base, tip)
