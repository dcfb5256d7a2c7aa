# SPDX-License-Identifier: Apache-2.0
"""Scenes: a table in front of the robot and the objects on it.

Positions are in the base frame (`world`, `openarm_body_link0`: x forward, y left, z up), metres; yaw is about z, rad.
A scene is a YAML file in `models/scenes`, or drawn from a seed. One that does not fit is refused with all its faults.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from pydantic import ValidationError

from openarm_common.config import describe_faults, load_yaml
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from openarm_common.scene.types import (
    DENSITY,
    MAX_EDGE,
    MIN_EDGE,
    PALETTE,
    SHAPES,
    Array,
    Fixture,
    Scene,
    SceneObject,
    Table,
)

__all__ = [
    "DENSITY",
    "MAX_EDGE",
    "MIN_EDGE",
    "PALETTE",
    "REGION_ABS_Y",
    "REGION_X",
    "SHAPES",
    "SPACING",
    "Fixture",
    "Scene",
    "SceneObject",
    "Table",
    "load_scene",
    "parse_object",
    "parse_scene",
    "random_scene",
]

#: Where an arm can grasp a cube of any yaw from above with a tilt up to 30°: x, and y to its own side.
REGION_X = (0.16, 0.36)
REGION_ABS_Y = (0.06, 0.42)
#: Centre to centre in a random scene: the open fingers reach 65 mm to either side, an object up to 50 mm.
SPACING = 0.12
_TOUCH = 1e-4  # m; closer than this is touching, not overlapping

ModelT = TypeVar("ModelT", Scene, SceneObject)


def parse_scene(data: Mapping[str, Any], where: str) -> Scene:
    """Validate a scene; `where` stands in front of every fault.

    Raises:
        OpenArmError: SCENE_INVALID, naming each wrong key, and each object that is not on the table, overlaps another,
            or has a name or label that is used twice.
    """
    scene = _parse(Scene, data, where)
    faults = [fault for item in scene.objects for fault in _off_table(item, scene.table)]
    faults += _duplicates("name", (item.name for item in (*scene.objects, *scene.fixtures)))
    faults += _duplicates("label", (item.label for item in scene.objects))
    for a, b in itertools.combinations(scene.objects, 2):
        depth = _overlap(a, b, scene.table)
        if depth > _TOUCH:
            faults.append(f"{_place(a)} and {_place(b)} overlap by {depth * 1e3:.1f} mm; move one of them")
    if faults:
        raise OpenArmError(Code.SCENE_INVALID, "; ".join(f"{where}: {fault}" for fault in faults))
    return scene


def parse_object(data: Mapping[str, Any], table: Table, where: str) -> SceneObject:
    """Validate one object that is to be put on (or above) a table.

    Raises:
        OpenArmError: SCENE_INVALID, naming each wrong key, or that it is not on the table.
    """
    item = _parse(SceneObject, data, where)
    faults = _off_table(item, table)
    if faults:
        raise OpenArmError(Code.SCENE_INVALID, "; ".join(f"{where}: {fault}" for fault in faults))
    return item


def load_scene(source: str | Path, seed: int = 0) -> Scene:
    """Read a scene.

    Args:
        source: Name of a file in `models/scenes`, a path ending in .yaml, or "random".
        seed: Of a random scene.

    Raises:
        OpenArmError: SCENE_INVALID, with the faults, or listing the scenes there are.
    """
    if source == "random":
        return random_scene(seed)
    folder = models_dir() / "scenes"
    path = Path(source)
    if path.suffix not in (".yaml", ".yml"):
        path = folder / f"{source}.yaml"
    if not path.is_file():
        names = sorted(file.stem for file in folder.glob("*.yaml"))
        raise OpenArmError(
            Code.SCENE_INVALID,
            f"no scene {str(source)!r}; scenes: {', '.join([*names, 'random'])}, or the path of a YAML",
        )
    try:
        data = load_yaml(path)
    except OpenArmError as error:
        raise OpenArmError(Code.SCENE_INVALID, error.message) from error
    return parse_scene({"name": path.stem} | data, str(path))


def random_scene(seed: int, count: int | None = None) -> Scene:
    """Draw a scene: one to four objects that either arm can grasp, each in its own colour.

    Cubes, boxes, cylinders and cans; faces and diameters of 40 to 70 mm, heights of 40 to 115 mm, 60 to 350 g.

    Args:
        seed: Same seed, same scene.
        count: How many objects; None draws it.
    """
    rng = np.random.default_rng(seed)
    number = int(rng.integers(1, 5)) if count is None else count
    colors = rng.permutation(list(PALETTE))[:number]
    spots: list[Array] = []
    while len(spots) < number:
        side = rng.choice((-1.0, 1.0))
        spot = np.array([rng.uniform(*REGION_X), side * rng.uniform(*REGION_ABS_Y)]).round(4)
        if all(np.hypot(*(spot - other)) >= SPACING for other in spots):
            spots.append(spot)
    objects: list[SceneObject] = []
    for color, spot in zip(colors, spots, strict=True):
        kind = str(rng.choice(("cube", "box", "cylinder", "can")))
        item = SceneObject(
            name=f"{color}_{kind}",
            shape="box" if kind in ("cube", "box") else "cylinder",
            size=_draw_size(rng, kind),
            color=str(color),
            position=(float(spot[0]), float(spot[1])),
            yaw=round(float(rng.uniform(-math.pi, math.pi)), 4),
        )
        objects.append(item.model_copy(update={"mass": round(min(max(item.mass_kg, 0.06), 0.35), 3)}))
    return parse_scene({"name": f"random_{seed}", "objects": objects}, f"random scene {seed}")


def _draw_size(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    if kind == "can":
        return (0.066, 0.066, 0.115)
    a, b = (round(float(edge), 3) for edge in rng.uniform(0.04, 0.07, size=2))
    if kind == "cube":
        return (a, a, a)
    if kind == "cylinder":
        b = a
    # Not taller than twice the narrow side: a slimmer one tips over when a finger touches it first.
    return (a, b, round(float(rng.uniform(0.04, min(0.115, 2.0 * min(a, b)))), 3))


def _parse(model: type[ModelT], data: Mapping[str, Any], where: str) -> ModelT:
    try:
        return model.model_validate(dict(data))
    except ValidationError as error:
        raise OpenArmError(Code.SCENE_INVALID, describe_faults(error, where, model)) from error


def _place(item: SceneObject) -> str:
    return f"object {item.name!r} at ({', '.join(f'{v:.3f}' for v in item.position)})"


def _off_table(item: SceneObject, table: Table) -> list[str]:
    outline = item.outline()
    low, high = outline.min(axis=0), outline.max(axis=0)
    faults: list[str] = []
    for axis, (edge_low, edge_high) in enumerate((table.x, table.y)):
        over = max(edge_low - low[axis], high[axis] - edge_high)
        if over > _TOUCH:
            faults.append(
                f"{_place(item)} is outside the table: {'xy'[axis]} spans {low[axis]:.3f} .. {high[axis]:.3f} m,"
                f" the table {edge_low:.3f} .. {edge_high:.3f} m"
            )
    bottom = item.centre(table)[2] - item.size[2] / 2.0
    if bottom < table.top_z - _TOUCH:
        faults.append(
            f"{_place(item)} is in the table: its bottom is at z {bottom:.3f}, the top at {table.top_z:.3f} m"
        )
    return faults


def _duplicates(what: str, values: Iterable[str]) -> list[str]:
    seen: set[str] = set()
    twice = [value for value in values if value in seen or seen.add(value)]
    return [f"{what} {value!r} is used twice; {what}s must be unique in a scene" for value in twice]


def _overlap(a: SceneObject, b: SceneObject, table: Table) -> float:
    """How deep two objects are in each other, m; 0 when apart. Separating axes of the outlines, and z."""
    outlines = (a.outline(), b.outline())
    edges = np.concatenate([np.roll(outline, -1, axis=0) - outline for outline in outlines])
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    spans = [outline @ normals.T for outline in outlines]
    depth = np.minimum(spans[0].max(axis=0), spans[1].max(axis=0)) - np.maximum(
        spans[0].min(axis=0), spans[1].min(axis=0)
    )
    vertical = (a.size[2] + b.size[2]) / 2.0 - abs(a.centre(table)[2] - b.centre(table)[2])
    return max(0.0, min(float(depth.min()), vertical))
