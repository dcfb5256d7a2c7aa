# SPDX-License-Identifier: Apache-2.0
"""The description in the forms that other tools read, and pictures of it."""

from __future__ import annotations

import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import mujoco

from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene
from openarm_common.types import Bytes
from openarm_sim_bridge.world.model import PhysicsConfig, build_spec, name_meshes, robot_spec
from openarm_sim_bridge.world.world import start_qpos

Kind = Literal["urdf", "mjcf", "srdf"]
_ASSET = re.compile(r'(?<![a-z])file="([^"]*)"')
_MESH_FILE = re.compile(r'filename="file://([^"]*)"')
#: Views: point looked at (m, world), distance (m), azimuth and elevation (degrees) as MuJoCo counts them.
VIEWS: Mapping[str, tuple[tuple[float, float, float], float, float, float]] = {
    "front": ((0.10, 0.0, 0.60), 1.75, 180.0, -10.0),
    "three_quarter": ((0.13, 0.0, 0.60), 1.55, 146.0, -18.0),
    "side": ((0.22, 0.0, 0.58), 1.55, 90.0, -6.0),
    "back": ((0.10, 0.0, 0.58), 1.6, -35.0, -16.0),
    "top": ((0.25, 0.0, 0.45), 1.6, 180.0, -75.0),
}


def export(kind: Kind, scene: str | None = None, seed: int = 0, folder: Path | None = None) -> str:
    """Return the description as text.

    Args:
        kind: "urdf": expanded, one file; "srdf"; "mjcf": as MuJoCo reads it, with actuators and contact settings
            (MuJoCo writes six digits).
        scene: Name or path of a scene to put around the robot in an MJCF, with the cameras; None is the robot alone.
        seed: Seed of the scene "random".
        folder: Folder in which the text will be: mesh files are named from there; None: by absolute paths.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for an unknown kind or a scene that the kind cannot hold; SCENE_INVALID.
    """
    description = RobotDescription.load()
    if scene is not None and kind != "mjcf":
        raise OpenArmError(Code.INVALID_ARGUMENT, f"a scene can be written as mjcf only, not as {kind}; leave it out")
    if kind == "urdf":
        if folder is None:
            return description.urdf
        return _MESH_FILE.sub(lambda m: f'filename="{_named(Path(m[1]), folder)}"', description.urdf)
    if kind == "srdf":
        return description.srdf
    if kind == "mjcf":
        if scene is None:
            spec = robot_spec(description, PhysicsConfig())
        else:
            spec = build_spec(description, load_scene(scene, seed), load_cameras())
        spec.compile()
        try:
            return _with_files(spec.to_xml(), description, folder)
        except mujoco.FatalError as error:
            text = f"MuJoCo can't write scene {scene!r} as XML: {error}"
            hint = "objects with a texture and a scene with an appearance are for the simulation alone"
            raise OpenArmError(Code.SCENE_INVALID, f"{text} {hint}") from error
    raise OpenArmError(Code.INVALID_ARGUMENT, f"unknown kind {kind!r}; kinds: urdf, mjcf, srdf")


def _with_files(mjcf: str, description: RobotDescription, folder: Path | None) -> str:
    """Name the robot's mesh files in an MJCF by where they are; in memory they have other names."""
    files = name_meshes(ET.fromstring(description.urdf))
    return _ASSET.sub(lambda m: f'file="{_named(files[m[1]], folder)}"' if m[1] in files else m[0], mjcf)


def _named(path: Path, folder: Path | None) -> str:
    """How a file in a folder names another: from there; without one by its absolute path."""
    return str(path) if folder is None else os.path.relpath(path, folder.absolute())


def render(
    scene: str = "demo",
    posture: str = "home",
    width: int = 1280,
    height: int = 960,
    *,
    view: str = "three_quarter",
    seed: int = 0,
    finger: float = 0.03,
) -> Bytes:
    """Draw robot and scene.

    Args:
        scene: Name or path of a scene, or "random".
        posture: State of the arms in the SRDF.
        width: Pixels.
        height: Pixels.
        view: One of `VIEWS`, or the name of a camera.
        seed: Seed of the scene "random".
        finger: Distance of the pads from the middle of the hands, m.

    Returns:
        (height, width, 3) RGB.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for an unknown view or posture; SCENE_INVALID.
    """
    description, cameras = RobotDescription.load(), load_cameras()
    if view not in VIEWS and view not in cameras:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"unknown view {view!r}; views: {', '.join(VIEWS)}; cameras: {', '.join(cameras)}"
        )
    q = {hand.joint: hand.position(finger) for hand in description.hands.values()}
    for arm in description.arm_names:
        q |= description.group_state(f"{arm}_arm", posture)
    spec = build_spec(description, load_scene(scene, seed), cameras)
    _light_for_people(spec)
    spec.visual.global_.offwidth, spec.visual.global_.offheight = max(width, 640), max(height, 480)
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = start_qpos(model, q)
    mujoco.mj_forward(model, data)
    camera: Any = view
    if view in VIEWS:
        camera = mujoco.MjvCamera()
        camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = VIEWS[view]
    with mujoco.Renderer(model, height, width) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render().copy()


def _light_for_people(spec: mujoco.MjSpec) -> None:
    """Give a picture what would cost a camera too much: a spot that throws shadows, and smooth edges."""
    key = spec.light("key")
    key.type = mujoco.mjtLightType.mjLIGHT_SPOT
    key.pos, key.dir = (1.3, -0.7, 2.7), (-1.1, 0.7, -2.2)
    key.cutoff, key.exponent, key.attenuation = 38.0, 0.0, (1.0, 0.0, 0.0)
    key.castshadow = True
    spec.visual.quality.shadowsize = 8192
    spec.visual.quality.offsamples = 8


def render_png(
    path: str | Path,
    scene: str = "demo",
    posture: str = "home",
    width: int = 1280,
    height: int = 960,
    *,
    view: str = "three_quarter",
    seed: int = 0,
) -> None:
    """Write a picture; arguments and errors as `render`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the file cannot be written.
    """
    image = render(scene, posture, width, height, view=view, seed=seed)
    ok, data = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
    if not ok:
        raise OpenArmError(Code.INTERNAL, f"PNG encoding of a {width} x {height} image failed")
    try:
        Path(path).write_bytes(data.tobytes())
    except OSError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"cannot write {path}: {error}") from error
