# SPDX-License-Identifier: Apache-2.0
"""Tasks with objects on boxes and shelf boards, to be picked from there, placed there, or both. Base frame, m."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.draws import first_fit
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import PALETTE, Scene, parse_scene, random_scene
from openarm_common.types import Array
from openarm_evaluation.campaign.tasks.task import Task

#: What is asked for, in turn.
KINDS = ("from_box", "on_box", "box_to_box", "from_shelf", "on_shelf")
#: Heights of tops over the table, edges of boxes and of boards, thickness of these and of the walls below them, m.
_HEIGHT, _EDGE, _BOARD, _THICK = (0.05, 0.25), (0.12, 0.18), ((0.18, 0.22), (0.24, 0.30)), 0.02
#: Mass of a part of a support, kg.
_MASS = 1.5
#: |y| of supports: the camera sees no farther to the side at their height, m.
_ASIDE = (0.12, 0.26)
#: Between things that stand side by side, m.
_APART = 0.04


def supports_task(seed: int) -> Task:
    """Make a task with an object, the supports that it comes from and goes to, and another object on the table."""
    rng, kind = np.random.default_rng([seed, 47]), KINDS[seed % len(KINDS)]
    what = f"supports {seed}: things side by side, {_APART:g} m apart"
    scene = first_fit(what, "enlarge work.region of robot.yaml", lambda: _drawn(rng, seed, kind))
    place_on = "" if kind.startswith("from") else scene.objects[-1].label
    return Task("supports", seed, scene, (scene.objects[0].label,), kind=kind, place_on=place_on)


def _drawn(rng: np.random.Generator, seed: int, kind: str) -> Scene | None:
    """Draw a scene, the object first and what it goes to last; None where things are too near to each other."""
    drawn = random_scene(seed, count=2).objects
    item, other = ({"mass": one.mass} | one.model_dump() for one in drawn)
    colors = [str(color) for color in rng.permutation(list(PALETTE)) if color not in (item["color"], other["color"])]
    side = float(rng.choice((-1.0, 1.0)))
    parts = _shelf(rng, side, "grey" if kind == "from_shelf" else colors[0]) if "shelf" in kind else []
    parts = parts or [_box(rng, side, colors[0])]
    if not kind.startswith("on"):
        top, reach = parts[-1], 0.5 * max(item["size"][:2])
        off = [rng.uniform(-1.0, 1.0) * max(0.5 * edge - reach, 0.0) for edge in top["size"][:2]]
        x, y, z = np.array(top["position"]) + se3.rot_z(top["yaw"]) @ (*off, 0.5 * top["size"][2])
        item["position"] = [round(float(v), 4) for v in (x, y, z + 0.5 * item["size"][2])]
    if kind == "box_to_box":
        parts.append(_box(rng, -side, colors[1]))
    standing = [
        other,
        *(part for part in parts if "wall" not in part["name"]),
        *([item] if kind.startswith("on") else []),
    ]
    for a, b in combinations(standing, 2):
        reach = 0.5 * sum(math.hypot(*one["size"][:2]) for one in (a, b))
        if math.dist(a["position"][:2], b["position"][:2]) < reach + _APART:
            return None
    return parse_scene({"name": f"supports_{seed}", "objects": [item, other, *parts]}, f"supports {seed}")


def _box(rng: np.random.Generator, side: float, color: str) -> dict[str, Any]:
    """Draw a box to stand on, on one side of the table."""
    size = (float(rng.uniform(*_EDGE)), float(rng.uniform(*_EDGE)), float(rng.uniform(*_HEIGHT)))
    return _part(
        f"{color}_support", color, size, _spot(rng, side), 0.5 * size[2], float(rng.uniform(-math.pi, math.pi))
    )


def _shelf(rng: np.random.Generator, side: float, color: str) -> list[dict[str, Any]]:
    """Draw a board on two walls, the board last."""
    (x, y), yaw, height = _spot(rng, side), float(rng.uniform(-0.3, 0.3)), float(rng.uniform(*_HEIGHT))
    deep, wide = (float(rng.uniform(*ends)) for ends in _BOARD)
    parts = [_part("shelf", color, (deep, wide, _THICK), (x, y), height - 0.5 * _THICK, yaw)]
    for name, sign in (("left_wall", 1.0), ("right_wall", -1.0)):
        p = np.array([x, y, 0.0]) + se3.rot_z(yaw) @ (0.0, sign * 0.5 * (wide - _THICK), 0.0)
        size = (deep, _THICK, height - _THICK)
        parts.insert(0, _part(name, "grey", size, (float(p[0]), float(p[1])), 0.5 * size[2], yaw))
    return parts


def _spot(rng: np.random.Generator, side: float) -> tuple[float, float]:
    return float(rng.uniform(*robot_work().region.x)), side * float(rng.uniform(*_ASIDE))


def _part(
    name: str, color: str, size: tuple[float, ...], xy: tuple[float, float], z: float, yaw: float
) -> dict[str, Any]:
    """Return a box of a support whose middle is so high over the table."""
    position = [round(v, 4) for v in (*xy, robot_work().table.top_z + z)]
    label = color if color != "grey" else name
    size = tuple(round(v, 4) for v in size)
    return {
        "name": name, "label": label, "shape": "box", "size": size, "color": color, "mass": _MASS,
        "position": position, "yaw": round(yaw, 4),
    }  # fmt: skip
