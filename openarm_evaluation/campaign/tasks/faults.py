# SPDX-License-Identifier: Apache-2.0
"""Fault injection: tasks with one fault each, and how they may end: placed, or refused with the right code.

Positions are in the base frame, m; the kind is the seed modulo the number of kinds, so that every kind comes as often.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType
from typing import Any

import numpy as np

from openarm_common.camera.cameras import detector_nodes, table_camera
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.tasks.task import FaultPlan, Task, nominal, past, within

_NOTHING_HELD = (Code.GRASP_MISSED, Code.GRASP_LOST)
#: The hand is off its plan: it meets the object, misses it, or is stopped.
_ASTRAY = (*_NOTHING_HELD, Code.HAND_COLLISION, Code.EXECUTION_FAILED, Code.PLACE_FAILED, Code.STALE_DATA)
#: The camera does not see the table where it was calibrated to.
_NOT_AS_CALIBRATED = (Code.INTRINSICS_MISMATCH, Code.TABLE_MISMATCH)
_NO_WAY = (Code.UNREACHABLE, Code.IN_COLLISION, Code.NO_PLAN)


def fault_task(seed: int) -> Task:
    """Make the task of a seed."""
    names = list(KINDS)
    kind = names[seed % len(names)]
    return KINDS[kind](replace(_single(seed), set_name="faults", kind=kind), np.random.default_rng([seed, 3]))


def _single(seed: int) -> Task:
    task = nominal(seed)
    return replace(task, labels=task.labels[:1])


Maker = Callable[[Task, np.random.Generator], Task]


def _fault(name: str, *codes: Code, when: str = "", until_attempt: int = 0, **parameters: Any) -> Maker:
    """Return a maker of a fault; of parameters, a pair (low, high) is drawn from, and what can be called is."""

    def make(task: Task, rng: np.random.Generator) -> Task:
        known = {k: v() if callable(v) else v for k, v in parameters.items()}
        drawn = {k: float(rng.uniform(*v)) if isinstance(v, tuple) else v for k, v in known.items()}
        return replace(task, fault=FaultPlan(name, drawn, when, until_attempt), codes=codes or (Code.OK,))

    return make


def _nudged(when: str) -> Maker:
    def make(task: Task, rng: np.random.Generator) -> Task:
        return _fault("object_nudged", when=when, object=_target(task).name, mm=(20.0, 50.0))(task, rng)

    return make


def _missed(task: Task, rng: np.random.Generator) -> Task:
    share = round(float(rng.uniform(0.2, 0.5)), 3)
    faults = (f"faults.miss_share={share}", f"faults.seed={task.seed}")
    return replace(task, sets=tuple(f"{node}.{fault}" for node in detector_nodes().values() for fault in faults))


def _plan_fails(task: Task, rng: np.random.Generator) -> Task:
    return replace(task, sets=("motion.faults.no_plan_share=1.0", "motion.faults.no_plan_limit=1"))


def _depth_patch(task: Task, rng: np.random.Generator) -> Task:
    parameters = {"camera": table_camera(), "u": int(rng.integers(150, 400)), "v": int(rng.integers(120, 300))}
    wrong = float(rng.choice((-1.0, 1.0)) * rng.uniform(0.03, 0.10))
    fault = FaultPlan("depth_patch", {**parameters, "metres": wrong}, until_attempt=2)
    return replace(task, fault=fault, codes=(Code.OK, *_ASTRAY, *_NO_WAY, Code.NOTHING_DETECTED, Code.UNKNOWN_OBJECT,
                                             Code.TOO_WIDE))  # fmt: skip


def _objects(task: Task, *objects: SceneObject) -> Scene:
    return task.scene.model_copy(update={"objects": objects, "name": f"{task.kind}_{task.seed}"})


def _target(task: Task) -> SceneObject:
    return next(item for item in task.scene.objects if item.label == task.labels[0])


def _empty(task: Task, rng: np.random.Generator) -> Task:
    return replace(task, scene=_objects(task), codes=(Code.NOTHING_DETECTED,))


def _unknown(task: Task, rng: np.random.Generator) -> Task:
    return replace(task, labels=("elephant",), codes=(Code.UNKNOWN_OBJECT,))


def _too_wide(task: Task, rng: np.random.Generator) -> Task:
    edge = round(float(rng.uniform(0.084, 0.10)), 3)
    wide = _target(task).model_copy(update={"shape": "box", "size": (edge, edge, 0.06)})
    return replace(task, scene=_objects(task, wide), codes=(Code.TOO_WIDE,))


def _far(task: Task, rng: np.random.Generator) -> Task:
    """Beyond the reach of the arms in x, near the end of their region to a side."""
    xs, ys = past(robot_work().region.x, 0.15, 0.17), past(robot_work().region.abs_y, -0.05, -0.02)
    x, y = round(float(rng.uniform(*xs)), 3), round(float(rng.choice((-1, 1)) * rng.uniform(*ys)), 3)
    far = _target(task).model_copy(update={"shape": "box", "size": (0.05, 0.05, 0.05), "position": (x, y)})
    return replace(task, scene=_objects(task, far), codes=_NO_WAY)


def _walled(task: Task, rng: np.random.Generator) -> Task:
    """Surround the object closely by boxes that are a little higher."""
    region, side = robot_work().region, float(rng.choice((-1.0, 1.0)))
    x = float(rng.uniform(*within(region.x, 0.06, 0.06)))
    y = side * float(rng.uniform(*within(region.abs_y, 0.12, 0.12)))
    low = _target(task).model_copy(update={"shape": "box", "size": (0.05, 0.05, 0.05), "position": (x, y), "yaw": 0.0})
    colors = [color for color in ("red", "orange", "yellow", "green", "blue", "purple") if color != low.color]
    walls: list[SceneObject] = []
    for color, (dx, dy, long_x, long_y) in zip(
        colors, ((0.055, 0, 0.04, 0.15), (-0.055, 0, 0.04, 0.15), (0, 0.055, 0.068, 0.04), (0, -0.055, 0.068, 0.04)),
        strict=False,
    ):  # fmt: skip
        size = (long_x, long_y, 0.055)
        walls.append(SceneObject(name=f"{color}_wall", shape="box", size=size, color=color, position=(x + dx, y + dy)))
    # where the walls hide its outline, it cannot be measured
    return replace(task, scene=_objects(task, low, *walls), codes=(*_NO_WAY, Code.NOTHING_DETECTED))


def _corridor(task: Task, rng: np.random.Generator) -> Task:
    """Put a tall screen between the object and the side of the arm."""
    region, side = robot_work().region, float(rng.choice((-1.0, 1.0)))
    x = float(rng.uniform(*within(region.x, 0.04, 0.08)))
    y = side * float(rng.uniform(*within(region.abs_y, 0.09, 0.17)))
    item = _target(task).model_copy(update={"position": (x, y)})
    color = "green" if item.color != "green" else "purple"
    size, place = (0.16, 0.03, round(float(rng.uniform(0.16, 0.24)), 3)), (x, y + side * 0.13)
    screen = SceneObject(name="screen", shape="box", size=size, color=color, position=place, mass=2.0)
    return replace(task, scene=_objects(task, item, screen))


def _heavy(task: Task, rng: np.random.Generator) -> Task:
    item = _target(task).model_copy(update={"mass": 8.0})
    codes = (*_NOTHING_HELD, Code.HAND_COLLISION, Code.EXECUTION_FAILED)
    return replace(task, scene=_objects(task, item), codes=codes)


def _place_off_table(task: Task, rng: np.random.Generator) -> Task:
    return replace(task, place=(round(task.scene.table.x[1] + 0.14, 3), 0.0), codes=(Code.INVALID_ARGUMENT,))


def _place_taken(task: Task, rng: np.random.Generator) -> Task:
    item = _target(task)
    x, y = item.position[0], item.position[1]
    color = "green" if item.color != "green" else "purple"
    side = 1.0 if y >= 0 else -1.0
    outer = within(robot_work().region.abs_y, 0.0, 0.14)[1]
    other = (x, y + side * 0.12) if abs(y) < outer else (x, y - side * 0.12)
    block = SceneObject(name="block", shape="box", size=(0.05, 0.05, 0.06), color=color, position=other)
    return replace(task, scene=_objects(task, item, block), place=other, codes=(Code.IN_COLLISION,))


def _two_alike(task: Task, rng: np.random.Generator) -> Task:
    """Two objects of one colour, on either side."""
    first = _target(task)
    x = first.position[0]
    y = -first.position[1]
    twin = first.model_copy(update={"name": f"{first.name}_twin", "position": (x, y), "yaw": first.yaw + 0.5})
    return replace(task, scene=_objects(task, first, twin))


def _arm_in_the_way(task: Task, rng: np.random.Generator) -> Task:
    """Hold the arms over the table, between the camera and the objects, when the request arrives."""
    posture: dict[str, float] = {}
    robot = RobotDescription.load()
    for arm in robot.arm_names:
        posture |= robot.group_state(f"{arm}_arm", "over_table")
    return replace(task, posture=posture)


#: Makers by kind. Those whose codes are OK alone must recover, those without OK must be refused.
KINDS: Mapping[str, Maker] = MappingProxyType(
    {
        # what must be recovered from
        "detection_missed": _missed,
        "frames_dropped": _fault("camera_drop", camera=table_camera, share=(0.4, 0.7)),
        "frames_late": _fault("camera_delay", camera=table_camera, seconds=(0.1, 0.25)),
        "stamps_off": _fault("stamp_offset", camera=table_camera, ms=(20.0, 100.0)),
        "light_changed": _fault("light_changed", scale=(0.5, 1.4)),
        "nudged_before_the_approach": _nudged("MOVE_TO_PREGRASP"),
        "nudged_before_the_grasp": _nudged("MOVE_TO_GRASP"),
        "slippery": _fault("friction_lowered", scale=(0.4, 0.7)),
        "gripper_stuck_once": _fault("gripper_stuck", when="CLOSE_GRIPPER", until_attempt=2, side="both"),
        "gripper_weak": _fault("gripper_weak", share=(0.4, 0.7)),
        "plan_fails_once": _plan_fails,
        "joint_states_gap": _fault("joint_state_gap", ms=(100.0, 300.0), every=2.0),
        "two_alike": _two_alike,
        "arms_in_the_way": _arm_in_the_way,
        "corridor_blocked": _corridor,
        # what must be refused; here, since the order gives each seed its kind
        "intrinsics_off": _fault(
            "intrinsics_bias", Code.INTRINSICS_MISMATCH, camera=table_camera, focal=(0.05, 1.0), cx=(-60.0, 60.0)
        ),
        # what may be recovered from, and must be reported truly when not
        "mount_knocked": _fault(
            "mount_knocked", Code.OK, *_ASTRAY, *_NO_WAY, *_NOT_AS_CALIBRATED, camera=table_camera, mm=10.0, deg=1.0
        ),
        "depth_patch": _depth_patch,
        "joints_late": _fault("joint_late", Code.OK, Code.EXECUTION_FAILED, ms=(50.0, 150.0)),
        "joints_sag": _fault("joint_sag", Code.OK, Code.HAND_COLLISION, Code.EXECUTION_FAILED, share=(0.3, 0.8)),
        # what is impossible
        "empty_table": _empty,
        "unknown_label": _unknown,
        "too_wide": _too_wide,
        "out_of_reach": _far,
        "walled_in": _walled,
        "too_heavy": _heavy,
        "icy": _fault("friction_lowered", *_NOTHING_HELD, Code.HAND_COLLISION, scale=0.02),
        "camera_dead": _fault("camera_drop", Code.STALE_DATA, camera=table_camera, share=1.0),
        "joint_states_silent": _fault("joint_state_gap", Code.ROBOT_LOST, when="PLAN", ms=9000.0, every=9.0),
        "gripper_stuck": _fault("gripper_stuck", Code.EXECUTION_FAILED, side="both"),
        "place_off_table": _place_off_table,
        "place_taken": _place_taken,
    }
)
