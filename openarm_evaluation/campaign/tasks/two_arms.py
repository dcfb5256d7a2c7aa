# SPDX-License-Identifier: Apache-2.0
"""Dual-arm tasks: a place that only the other arm reaches, an object that neither arm can grasp where it is.

Base frame, m; all is drawn from the seed. `Task.route` is the route by which the object must come to its place.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import PALETTE, Scene, SceneObject, parse_scene, random_scene
from openarm_evaluation.campaign.in_process_robot import approach_of
from openarm_evaluation.campaign.robot import arms_behind
from openarm_evaluation.campaign.tasks.task import Task, past, within
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import propose, shorter, target_box
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.robot.interface import PlanGrasp
from openarm_motion.planning.approach import plan_approach

#: Least distance of an object of a hand-over, and of its place, from the near end of the region, m: the other arm
#: reaches over the middle, less far.
_ASIDE = 0.20
#: And of the objects around.
_BESIDE = 0.10
#: Between the middles of a place and any object, m.
_APART = 0.13


def handover_task(seed: int) -> Task:
    """Request an object on one arm's side to be placed on the other's; up to two others around, not in the middle."""
    rng, region = np.random.default_rng([seed, 4]), robot_work().region
    aside, beside = (round(region.abs_y[0] + distance, 3) for distance in (_ASIDE, _BESIDE))
    xs, ys = within(region.x, 0.02, 0.02), (aside, within(region.abs_y, 0.0, 0.02)[1])
    while True:
        scene = random_scene(int(rng.integers(1 << 31)), count=int(rng.integers(1, 4)))
        first = scene.objects[0]
        others = [np.array(item.position[:2]) for item in scene.objects[1:]]
        if abs(first.position[1]) < aside or any(abs(p[1]) < beside for p in others):
            continue
        side = -np.sign(first.position[1])
        place = np.array([rng.uniform(*xs), side * rng.uniform(*ys)]).round(3)
        if all(np.linalg.norm(place - p) >= _APART for p in others):
            break
    named = scene.model_copy(update={"name": f"handover_{seed}"})
    xy = (float(place[0]), float(place[1]))
    return Task("handover", seed, named, (first.label,), kind="handover", place=xy, route="hand_over")


def pair_task(seed: int) -> Task:
    """Request two objects simultaneously, one for each arm; up to two others around."""
    rng = np.random.default_rng([seed, 6])
    while True:
        scene = random_scene(int(rng.integers(1 << 31)), count=int(rng.integers(2, 5)))
        left = [item for item in scene.objects if item.position[1] > 0.0]
        right = [item for item in scene.objects if item.position[1] < 0.0]
        if left and right:
            break
    named = scene.model_copy(update={"name": f"pair_{seed}"})
    return Task("pairs", seed, named, (left[0].label, right[0].label), kind="pair", together=True)


def in_turn_task(seed: int) -> Task:
    """Request the same one after the other, to compare the time of a pair."""
    return replace(pair_task(seed), set_name="pairs_in_turn", kind="pair in turn", together=False)


def push_task(seed: int) -> Task:
    """Request an object between the arms, turned so that neither can grasp it where it is."""
    rng = np.random.default_rng([seed, 5])
    while True:
        scene = _one_object(seed, rng)
        if not any(_graspable(scene, arm) for arm in RobotDescription.load().arm_names):
            return Task("push", seed, scene, (scene.objects[0].label,), kind="push", route="push")


def _one_object(seed: int, rng: np.random.Generator) -> Scene:
    """Draw an object that no arm can grasp but a hand can push: past the region, between the arms."""
    region = robot_work().region
    xs, half = past(region.x, 0.01, 0.07), region.abs_y[0] / 2.0
    color = str(rng.choice(list(PALETTE)))
    a, b, c = (round(float(edge), 3) for edge in rng.uniform((0.04, 0.04, 0.04), (0.07, 0.07, 0.06)))
    item = SceneObject(
        name=f"{color}_box",
        shape="box",
        size=(a, b, c),
        color=color,
        position=(round(float(rng.uniform(*xs)), 3), round(float(rng.uniform(-half, half)), 3)),
        yaw=round(float(rng.uniform(-np.pi, np.pi)), 3),
        mass=round(float(rng.uniform(0.06, 0.25)), 3),
    )
    return parse_scene({"name": f"push_{seed}", "objects": [item]}, f"push scene {seed}")


def _graspable(scene: Scene, arm: str) -> bool:
    """Whether an arm at home finds a plan for the first object, known without an error."""
    table, item, config = scene.table, scene.objects[0], GraspConfig()
    T = se3.make(se3.rot_z(item.yaw), item.centre(table))
    target = Detection(item.label, 1.0, T, np.array(item.size))
    solver = arms_behind((), table)[arm]
    grasps = propose(target, config, RobotDescription.load().hand(arm).parts)
    for ways in (grasps, tuple(shorter(one) for one in grasps)):
        request = approach_of(PlanGrasp(arm, ways, (), (target_box(target, config),)))
        try:
            plan_approach(solver, solver.start_state(_home()), request)
        except OpenArmError as error:
            if error.code not in NO_WAY:
                raise
        else:
            return True
    return False


def _home() -> Mapping[str, float]:
    robot = RobotDescription.load()
    state = dict.fromkeys(robot.joints, 0.0)
    for side in robot.arm_names:
        state |= robot.group_state(f"{side}_arm", GraspConfig().home_state)
    return state
