# SPDX-License-Identifier: Apache-2.0
"""Objects that are dropped together and settle by physics, without the robot. World frame, m, s."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from openarm_common import se3
from openarm_common.robot.work import Table
from openarm_common.scene.scene import SceneObject
from openarm_common.types import Array
from openarm_sim_bridge.world.model import PhysicsConfig, set_options
from openarm_sim_bridge.world.scenery import add_environment, add_object, add_table
from openarm_sim_bridge.world.world import compiled_model

#: Height of the lowest above the table, and of each above the one before, m.
_FIRST, _NEXT = 0.10, 0.10
#: How long they fall between walls, and lie without them, at most; what is slower for so long is at rest, s.
_FALL, _LIE, _STILL = 5.0, 6.0, 0.5
#: m/s or rad/s.
_SLOW = 0.005
#: What lies on or against another thing is this deep in it at most, m. What falls on a thin thing may pass into it, and
#: is driven about by both for as long as it is there.
_DEEPEST = 0.001
_WALL = 0.01


def dropped(
    sources: Sequence[str], table: Table, centre: tuple[float, float], half: float, rng: np.random.Generator
) -> list[SceneObject]:
    """Return objects as they lie after they were dropped one above the other, between walls that are then taken away.

    Args:
        sources: Objects, same as for `openarm_common.objects.model.load_object`.
        table: Table that they fall on.
        centre: (x, y) above which they are dropped, m.
        half: Half of the distance of the walls, m.
        rng: Turns them.

    Returns:
        Those that came to rest on the table, in the order of `sources`; none, when one of them is driven into another.
    """
    items: list[SceneObject] = []
    for k, source in enumerate(sources):
        q = rng.normal(size=4)
        p = np.array(centre) + rng.uniform(-0.3, 0.3, 2) * half
        height = table.top_z + _FIRST + _NEXT * k
        items.append(_item(f"thing_{k}", source, q / np.linalg.norm(q), (*p, height)))
    items, _ = _settled(items, table, _FALL, (*centre, half))
    items, jammed = _settled(items, table, _LIE)
    staying = [item for item in items if _on(item, table)]
    return [] if any(pair <= {item.name for item in staying} for pair in jammed) else staying


def _item(name: str, source: str, q_xyzw: Array, position: Sequence[float]) -> SceneObject:
    data = {"name": name, "shape": "mesh", "object": source, "attitude": [float(v) for v in q_xyzw]}
    return SceneObject.model_validate({**data, "position": [round(float(v), 6) for v in position]})


def _on(item: SceneObject, table: Table) -> bool:
    outline = item.outline()
    inside = [
        low <= outline[:, k].min() and outline[:, k].max() <= high for k, (low, high) in enumerate((table.x, table.y))
    ]
    return all(inside) and item.centre(table)[2] > table.top_z


def _settled(
    items: Sequence[SceneObject], table: Table, seconds: float, walls: tuple[float, float, float] | None = None
) -> tuple[list[SceneObject], list[set[str]]]:
    """Return the objects as they lie when all are at rest, or after some time, and which are driven into each other."""
    spec, physics = mujoco.MjSpec(), PhysicsConfig()
    set_options(spec, physics)
    contact: dict[str, Any] = {
        "friction": physics.object_friction,
        "solref": physics.contact_solref,
        "solimp": physics.contact_solimp,
    }
    add_environment(spec, contact)
    add_table(spec, table, contact)
    for item in items:
        add_object(spec, item, table, contact, physics.object_condim)
    if walls is not None:
        _add_walls(spec, table, walls)
    model = compiled_model(spec)
    data = mujoco.MjData(model)
    still = 0.0
    while data.time < seconds and still < _STILL:
        mujoco.mj_step(model, data, nstep=50)
        still = still + 50 * model.opt.timestep if np.abs(data.qvel).max() < _SLOW else 0.0
    mujoco.mj_forward(model, data)
    deep = np.flatnonzero(data.contact.dist < -_DEEPEST)
    jammed = [{model.body(model.geom_bodyid[geom]).name for geom in data.contact.geom[k]} for k in deep]
    out: list[SceneObject] = []
    for item in items:
        body, posed = data.body(item.name), item.posed
        T = se3.make(np.reshape(body.xmat, (3, 3)), body.xpos) @ posed.T_box_object
        points = se3.apply(T, posed.model.points)
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        out.append(_item(item.name, item.object, se3.quat_xyzw_from_matrix(T[:3, :3]), middle))
    return out, jammed


def _add_walls(spec: mujoco.MjSpec, table: Table, walls: tuple[float, float, float]) -> None:
    x, y, half = walls
    for dx, dy in ((1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)):
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=(x + dx * (half + _WALL), y + dy * (half + _WALL), table.top_z + 0.75),
            size=(_WALL if dx else half + _WALL, _WALL if dy else half + _WALL, 0.75),
            friction=(0.1, 0.005, 0.0001),
        )
