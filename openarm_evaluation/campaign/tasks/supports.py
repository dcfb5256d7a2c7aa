# SPDX-License-Identifier: Apache-2.0
"""Tasks with objects on boxes and shelf boards, to be picked from there, placed there, or both. Base frame, m."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Any

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.draws import first_fit
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import PALETTE, Scene, parse_scene, random_scene
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.tasks.two_arms import reaches
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.planning.candidates import held_boxes, propose, target_box
from openarm_grasp.planning.place import place_targets
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace

#: What is asked for, in turn.
KINDS = ("from_box", "on_box", "box_to_box", "from_shelf", "on_shelf")
#: Heights of tops over the table, edges of boxes and of boards, thickness of these and of the walls below them, m.
_HEIGHT, _EDGE, _BOARD, _THICK = (0.05, 0.25), (0.12, 0.18), ((0.18, 0.22), (0.24, 0.30)), 0.02
#: Mass of a part of a support, kg; between things that stand side by side, m.
_MASS, _APART = 1.5, 0.08
#: Most |y| of a support, m: what stands on it is in view of the camera over the table.
_ASIDE = 0.30
#: Room for a hand at a place on the table, m.
_HAND = 0.08
#: Grasps of an object that are looked at, best first.
_GRASPS = 4
#: Scenes that are drawn until one fits: of those with two boxes one in some hundreds does.
_DRAWS = 100_000


def supports_task(seed: int) -> Task:
    """Make a task with an object, the supports that it comes from and goes to, and another object on the table."""
    rng, kind = np.random.default_rng([seed, 47]), KINDS[seed % len(KINDS)]
    what = f"supports {seed}: things side by side that an arm reaches where they stand and where they go"
    scene, (x, y, _) = first_fit(what, "enlarge work.region of robot.yaml", lambda: _drawn(rng, seed, kind), _DRAWS)
    labels = (scene.objects[0].label,)
    if kind.startswith("from"):
        return Task("supports", seed, scene, labels, kind=kind, place=(x, y))
    return Task("supports", seed, scene, labels, kind=kind, place_on=scene.objects[-1].label)


def _drawn(rng: np.random.Generator, seed: int, kind: str) -> tuple[Scene, list[float]] | None:
    """Draw a scene, the object first and what it goes to last, and where it goes; None where it does not fit."""
    item, other = (one.model_dump() for one in random_scene(int(rng.integers(1 << 31)), count=2).objects)
    colors = [str(color) for color in rng.permutation(list(PALETTE)) if color not in (item["color"], other["color"])]
    side, raised = float(rng.choice((-1.0, 1.0))), not kind.startswith("on")
    if kind.endswith("shelf"):
        parts = _shelf(rng, side, "grey" if raised else colors[0])
    else:
        parts = [_box(rng, side, colors[0])]
    standing = [other, parts[-1], *([] if raised else [item])]
    if raised:
        off = [
            max(0.5 * (edge - max(item["size"][:2])), 0.0) * rng.uniform(-1.0, 1.0) for edge in parts[-1]["size"][:2]
        ]
        p = np.array(_top(parts[-1])) + se3.rot_z(parts[-1]["yaw"]) @ (*off, 0.5 * item["size"][2])
        item["position"] = [round(float(v), 4) for v in p]
    if kind == "box_to_box":
        parts.append(_box(rng, side, colors[1], nearest=-_ASIDE / 4.0))
        standing.append(parts[-1])
    place = _top(parts[-1])
    if kind.startswith("from"):
        x, y = rng.uniform(*robot_work().region.x), side * rng.uniform(*robot_work().region.abs_y)
        place = [round(float(x), 3), round(float(y), 3), robot_work().table.top_z]
        standing.append({"position": place, "size": (_HAND, _HAND)})
    for a, b in combinations(standing, 2):
        radii = 0.5 * sum(math.hypot(*one["size"][:2]) for one in (a, b))
        if math.dist(a["position"][:2], b["position"][:2]) < radii + _APART:
            return None
    try:
        scene = parse_scene({"name": f"supports_{seed}", "objects": [item, other, *parts]}, f"supports {seed}")
    except OpenArmError as error:
        if error.code is not Code.SCENE_INVALID:
            raise
        return None  # over the edge of the table
    return (scene, place) if _in_reach(scene, place) else None


def _in_reach(scene: Scene, place: list[float]) -> bool:
    """Whether an arm on the side of the first object can grasp it so that it reaches its place (3,)."""
    item, config = scene.objects[0], GraspConfig()
    target = Detection(item.label, 1.0, item.T_world_object(scene.table), np.array(item.size), item.shape != "box")
    context = GraspContext.of(config, scene.table, RobotDescription.load())
    for arm in context.arm_order("auto", float(target.p_base[1])):
        for grasp in propose(target, config, context.parts(arm))[:_GRASPS]:
            held = held_boxes(target, grasp, config)
            put = PlanPlace(arm, place_targets(target, grasp, [np.array(place)], config), (), held)
            take = PlanGrasp(arm, (grasp,), (), (target_box(target, config),))
            if reaches(scene.table, take) and reaches(scene.table, put):
                return True
    return False


def _box(rng: np.random.Generator, side: float, color: str, nearest: float | None = None) -> dict[str, Any]:
    """Draw a box to stand on, on one side of the table; `nearest` to its middle, m, may be beyond that."""
    size = (float(rng.uniform(*_EDGE)), float(rng.uniform(*_EDGE)), float(rng.uniform(*_HEIGHT)))
    yaw = float(rng.uniform(-math.pi, math.pi))
    return _part(f"{color}_support", color, size, (*_spot(rng, side, nearest), 0.5 * size[2]), yaw)


def _shelf(rng: np.random.Generator, side: float, color: str) -> list[dict[str, Any]]:
    """Draw a board on two walls, the board last."""
    (x, y), yaw, height = _spot(rng, side), float(rng.uniform(-0.3, 0.3)), float(rng.uniform(*_HEIGHT))
    deep, wide = (float(rng.uniform(*ends)) for ends in _BOARD)
    parts = list[dict[str, Any]]()
    for name, sign in (("left_wall", 1.0), ("right_wall", -1.0)):
        p = np.array([x, y, 0.5 * (height - _THICK)]) + se3.rot_z(yaw) @ (0.0, sign * 0.5 * (wide - _THICK), 0.0)
        parts.append(_part(name, "grey", (deep, _THICK, height - _THICK), p.tolist(), yaw))
    return [*parts, _part("shelf", color, (deep, wide, _THICK), (x, y, height - 0.5 * _THICK), yaw)]


def _spot(rng: np.random.Generator, side: float, nearest: float | None = None) -> tuple[float, float]:
    region = robot_work().region
    nearest = region.abs_y[0] if nearest is None else nearest
    return float(rng.uniform(*region.x)), side * float(rng.uniform(nearest, min(region.abs_y[1], _ASIDE)))


def _part(name: str, color: str, size: tuple[float, ...], p: tuple[float, ...], yaw: float) -> dict[str, Any]:
    """Return a box of a support whose middle is at a point over the table."""
    size, position = (tuple(round(float(v), 4) for v in values) for values in (size, p))
    position = (*position[:2], round(robot_work().table.top_z + position[2], 4))
    return {
        "name": name, "label": name if color == "grey" else color, "shape": "box", "size": size, "color": color,
        "mass": _MASS, "position": position, "yaw": round(yaw, 4),
    }  # fmt: skip


def _top(part: dict[str, Any]) -> list[float]:
    """Return the middle (3,) of the upper face of a part."""
    x, y, z = part["position"]
    return [x, y, z + 0.5 * part["size"][2]]
