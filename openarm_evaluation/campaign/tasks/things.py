# SPDX-License-Identifier: Apache-2.0
"""Tasks with objects of any shape: each alone on one of its sides, and several dropped on a heap. Base frame, m."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.model import SUPERQUADRIC, load_object, object_names
from openarm_common.printable import brief
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import Scene, SceneObject, parse_scene
from openarm_evaluation.campaign.tasks.settle import dropped
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.judging.graspable import Graspable, GraspJudge

#: Suites of these tasks.
THINGS = ("objects", "heap")
#: How what can't be grasped may end, besides that it is placed in spite of it.
REFUSED = (Code.TOO_WIDE, Code.UNREACHABLE, Code.IN_COLLISION, Code.NO_PLAN)
#: What is asked for: nothing is known of the objects.
_ANY = "anything"
_SUPERQUADRICS = "superquadrics:"
_MOST = 1_000_000
#: Objects of a heap, and half of the edge of where they are dropped, m.
_HEAP, _HEAP_HALF = (5, 10), 0.11
_TRIES, _DROPS = 200, 20


def object_sources(text: str) -> tuple[str, ...]:
    """Return the objects that an option means.

    Args:
        text: "" for those of models/objects, `superquadrics:N` for so many, or a folder that holds object folders.

    Raises:
        OpenArmError: INVALID_ARGUMENT, saying what was expected.
    """
    if text.startswith(_SUPERQUADRICS):
        count = text.removeprefix(_SUPERQUADRICS)
        if not (count.isdecimal() and len(count) < 8 and 0 < int(count) <= _MOST):
            text = f"--objects {brief(text)}: expected superquadrics:N with N from 1 to {_MOST}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        return tuple(f"{SUPERQUADRIC}{k}" for k in range(int(count)))
    if not text:
        return object_names()
    folder = Path(text)
    names = object_names(folder)
    if not names:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"--objects {brief(text)}: no folder in it has an object.yaml; expected a folder of object folders, or"
            " superquadrics:N",
        )
    return tuple(str(folder.resolve() / name) for name in names)


def objects_task(seed: int, objects: str = "") -> Task:
    """Make a task with one object, the seed modulo their number, on one of its sides, for either arm.

    Args:
        seed: Seed of side, place, turn and appearance.
        objects: Objects, same as for `object_sources`.
    """
    sources, rng = object_sources(objects), np.random.default_rng([seed, 41])
    source, region = sources[seed % len(sources)], robot_work().region
    side = int(rng.integers(len(load_object(source).sides)))
    for attempt in range(_TRIES):
        y = float(rng.choice((-1.0, 1.0))) * float(rng.uniform(*region.abs_y))
        thing = {
            "name": "thing",
            "shape": "mesh",
            "object": source,
            "side": side,
            "position": [round(float(rng.uniform(*region.x)), 4), round(y, 4)],
            "yaw": round(float(rng.uniform(-math.pi, math.pi)), 4),
        }
        try:
            scene = parse_scene({"name": f"objects_{seed}", "objects": [thing], "appearance": seed}, f"objects {seed}")
        except OpenArmError:
            if attempt == _TRIES - 1:
                raise
            continue  # it would be over the edge of the table
        return _task("objects", seed, scene)
    raise AssertionError


def heap_task(seed: int, objects: str = "") -> Task:
    """Make a task with five to ten objects that were dropped together, all of them requested; as `objects_task`.

    Where too many have rolled off the table, or one was driven into another, others are dropped.
    """
    sources, rng = object_sources(objects), np.random.default_rng([seed, 43])
    work, items = robot_work(), list[SceneObject]()
    for _ in range(_DROPS):
        chosen = _drawn(sources, int(rng.integers(_HEAP[0], _HEAP[1] + 1)), rng)
        # in the middle, where both arms come: both sides are free for what is cleared
        items = dropped(chosen, work.table, (0.5 * sum(work.region.x), 0.0), _HEAP_HALF, rng)
        if len(items) >= _HEAP[0]:
            break
    else:
        text = f"heap {seed}: fewer than {_HEAP[0]} objects stay on the table in each of {_DROPS} drops"
        text += ", or one is driven into another; expected --objects that come to rest where they fall"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    # what lies in a heap overlaps, seen from above: the scene is one of physics, and not checked as one of a file
    scene = Scene(name=f"heap_{seed}", objects=tuple(items), appearance=seed)
    return _task("heap", seed, scene)


def _drawn(sources: Sequence[str], count: int, rng: np.random.Generator) -> list[str]:
    chosen = rng.choice(len(sources), size=count, replace=len(sources) < count)
    return [sources[int(k)] for k in chosen]


def _task(suite: str, seed: int, scene: Scene) -> Task:
    judge = GraspJudge.at(scene.table)
    found: dict[str, Graspable] = {
        item.name: judge.decide(item.posed.parts, item.T_world_object(scene.table)) for item in scene.objects
    }
    possible = all(one.yes for one in found.values())
    return Task(
        suite,
        seed,
        scene,
        (_ANY,) * len(scene.objects),
        kind="graspable" if possible else "not graspable" if suite == "objects" else "some not graspable",
        codes=(Code.OK,) if possible else (Code.OK, *REFUSED),
        clear=len(scene.objects) > 1,
        graspable={name: one.reason for name, one in found.items()},
    )
