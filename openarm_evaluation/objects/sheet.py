# SPDX-License-Identifier: Apache-2.0
"""A picture of objects on a table, each resting on a side, with their names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import mujoco
import numpy as np
from numpy.typing import NDArray

from openarm_common.robot.work import Table
from openarm_common.scene.scene import Scene, SceneObject
from openarm_sim_bridge.cameras.renderer import create_gl_context
from openarm_sim_bridge.world.appearance import vary
from openarm_sim_bridge.world.model import PhysicsConfig
from openarm_sim_bridge.world.scenery import add_environment, add_object, add_table

#: Edge of the field of an object, m; picture, pixels.
_FIELD, _SIZE = 0.24, (1600, 1200)
_TOP = 0.4


def write_sheet(
    path: Path, sources: Sequence[str], side: int = 0, *, parts: bool = False, seed: int | None = None
) -> None:
    """Draw objects in rows on one table.

    Args:
        path: Path of the PNG.
        sources: Same as for `openarm_common.objects.model.load_object`.
        side: Side that each rests on; its last one where it has fewer.
        parts: Draw the convex parts instead of what is seen.
        seed: Seed of lamps, table and paper; None: plain.

    Raises:
        OpenArmError: Same as `load_object`; ENVIRONMENT without OpenGL.
    """
    columns = math.ceil(math.sqrt(1.4 * len(sources)))
    rows = math.ceil(len(sources) / columns)
    width, depth = columns * _FIELD, rows * _FIELD
    table = Table(top_z=_TOP, x=(0.2, 0.2 + depth), y=(-0.5 * width, 0.5 * width), thickness=0.04)
    items: list[SceneObject] = []
    for k, source in enumerate(sources):
        row, column = divmod(k, columns)
        place = (0.2 + depth - (row + 0.5) * _FIELD, 0.5 * width - (column + 0.5) * _FIELD)
        data = {"name": f"item_{k}", "shape": "mesh", "object": source, "position": place, "yaw": 0.6}
        first = SceneObject.model_validate(data)
        last = min(side, len(first.posed.model.sides) - 1)
        items.append(SceneObject.model_validate({**data, "side": last}))
    picture = _drawn(Scene.model_construct(table=table, objects=tuple(items)), parts, seed)
    cv2.imwrite(str(path), picture[..., ::-1])


def _drawn(scene: Scene, parts: bool, seed: int | None) -> NDArray[np.uint8]:
    spec, settings = mujoco.MjSpec(), PhysicsConfig()
    contact = {"friction": settings.object_friction}
    add_environment(spec, contact)
    add_table(spec, scene.table, contact)
    if seed is not None:
        vary(spec, scene.table, seed)
    for item in scene.objects:
        add_object(spec, item, scene.table, contact, settings.object_condim)
    width, height = _SIZE
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.quality.offsamples = 4
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    view = mujoco.MjvCamera()
    view.lookat[:] = (*scene.table.centre, _TOP)
    view.distance = 1.15 * max(scene.table.extents[:2])
    view.azimuth, view.elevation = 0.0, -55.0
    option = mujoco.MjvOption()
    option.geomgroup[1], option.geomgroup[3] = not parts, parts
    gl = create_gl_context(width, height)
    try:
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
        drawn = mujoco.MjvScene(model, 4000)
        drawn.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        mujoco.mjv_updateScene(model, data, option, None, view, mujoco.mjtCatBit.mjCAT_ALL, drawn)
        rect, picture = mujoco.MjrRect(0, 0, width, height), np.empty((height, width, 3), np.uint8)
        mujoco.mjr_render(rect, drawn, context)
        mujoco.mjr_readPixels(picture, None, rect, context)
        context.free()
    finally:
        gl.free()
    picture = np.ascontiguousarray(picture[::-1])
    for item in scene.objects:
        u, v = _pixel(view, model.vis.global_.fovy, np.array([item.position[0] - 0.1, item.position[1], _TOP]))
        name = Path(item.object).name
        cv2.putText(picture, name, (int(u) - 4 * len(name), int(v)), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, 16)
    return picture


def _pixel(view: mujoco.MjvCamera, fovy: float, point: NDArray[np.float64]) -> tuple[float, float]:
    """Return where a free camera sees a point (3,), pixels."""
    turn, lift = math.radians(view.azimuth), math.radians(view.elevation)
    ahead = np.array([math.cos(lift) * math.cos(turn), math.cos(lift) * math.sin(turn), math.sin(lift)])
    right = np.array([math.sin(turn), -math.cos(turn), 0.0])
    seen = point - (np.array(view.lookat) - view.distance * ahead)
    scale = 0.5 * _SIZE[1] / math.tan(math.radians(0.5 * fovy)) / float(seen @ ahead)
    return 0.5 * _SIZE[0] + scale * float(seen @ right), 0.5 * _SIZE[1] - scale * float(seen @ np.cross(right, ahead))
