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
from openarm_common.draws import first_fit
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.robot.work import Table
from openarm_common.scene.scene import PALETTE, Scene, SceneObject, parse_scene, random_scene
from openarm_common.types import Array
from openarm_evaluation.campaign.in_process_robot import approach_of
from openarm_evaluation.campaign.robot import arms_behind
from openarm_evaluation.campaign.tasks.task import Task, crowded_scene, past, within
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.sightings import standing_at
from openarm_grasp.planning.candidates import propose, shorter, target_box
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.planning.pushes import closed_hand, destinations, push_ways
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace
from openarm_motion.planning.approach import plan_approach

#: Least distance of an object of a hand-over, and of its place, from the near end of the region, m: the other arm
#: reaches over the middle, less far.
_ASIDE = 0.20
#: And of the objects around.
_BESIDE = 0.10
#: Between the middles of a place and any object, m.
_APART = 0.13
#: An object to push stands at most this much past the region, m.
_FARTHER = 0.16
_REGION = "work.region of robot.yaml"
#: Objects of an order.
_ORDERED = 6


def handover_task(seed: int) -> Task:
    """Request an object on one arm's side to be placed on the other's; up to two others around, not in the middle."""
    rng, region = np.random.default_rng([seed, 4]), robot_work().region
    aside, beside = (round(region.abs_y[0] + distance, 3) for distance in (_ASIDE, _BESIDE))
    xs, ys = within(region.x, 0.02, 0.02), (aside, within(region.abs_y, 0.0, 0.02)[1])

    def draw() -> Task | None:
        scene = random_scene(int(rng.integers(1 << 31)), count=int(rng.integers(1, 4)))
        first = scene.objects[0]
        others = [np.array(item.position[:2]) for item in scene.objects[1:]]
        if abs(first.position[1]) < aside or any(abs(p[1]) < beside for p in others):
            return None
        side = -np.sign(first.position[1])
        place = np.array([rng.uniform(*xs), side * rng.uniform(*ys)]).round(3)
        if any(np.linalg.norm(place - p) < _APART for p in others):
            return None
        named, xy = scene.model_copy(update={"name": f"handover_{seed}"}), (float(place[0]), float(place[1]))
        return Task("handover", seed, named, (first.label,), kind="handover", place=xy, route="hand_over")

    what = f"handover {seed}: an object on one side and its place on the other, |y| from {aside:g} m on"
    return first_fit(what, f"enlarge {_REGION}", draw)


def pair_task(seed: int) -> Task:
    """Request two objects simultaneously, one for each arm; up to two others around."""
    rng = np.random.default_rng([seed, 6])

    def draw() -> Task | None:
        scene = random_scene(int(rng.integers(1 << 31)), count=int(rng.integers(2, 5)))
        left = [item for item in scene.objects if item.position[1] > 0.0]
        right = [item for item in scene.objects if item.position[1] < 0.0]
        if not (left and right):
            return None
        named = scene.model_copy(update={"name": f"pair_{seed}"})
        return Task("pairs", seed, named, (left[0].label, right[0].label), kind="pair", together=True)

    return first_fit(f"pairs {seed}: an object on either side", f"enlarge {_REGION}", draw)


def in_turn_task(seed: int) -> Task:
    """Request the same one after the other, to compare the time of a pair."""
    return replace(pair_task(seed), set_name="pairs_in_turn", kind="pair in turn", together=False)


def order_task(seed: int) -> Task:
    """Request all of six objects of one order, which both arms carry out."""
    scene = crowded_scene(seed, _ORDERED)
    labels = ("anything",) * _ORDERED
    return Task("orders", seed, scene, labels, kind="order", clear=True, together=True)


def push_task(seed: int) -> Task:
    """Request an object between the arms that neither can grasp where it is, and one can push into reach."""
    rng = np.random.default_rng([seed, 5])

    def draw() -> Task | None:
        scene = _one_object(seed, rng)
        if not _to_push(scene):
            return None
        return Task("push", seed, scene, (scene.objects[0].label,), kind="push", route="push")

    begin = robot_work().region.x[1]
    what = (
        f"push {seed}: a box of 40 to 70 mm between the arms, x from {begin:g} m on, to be pushed before it is grasped"
    )
    return first_fit(what, f"enlarge {_REGION} to all that the arms grasp, or its table", draw)


def _one_object(seed: int, rng: np.random.Generator) -> Scene:
    """Draw an object between the arms, past the region."""
    region, half = robot_work().region, robot_work().region.abs_y[0] / 2.0
    color = str(rng.choice(list(PALETTE)))
    a, b, c = (round(float(edge), 3) for edge in rng.uniform((0.04, 0.04, 0.04), (0.07, 0.07, 0.06)))
    item = SceneObject(
        name=f"{color}_box",
        shape="box",
        size=(a, b, c),
        color=color,
        position=(
            round(float(rng.uniform(*past(region.x, 0.0, _FARTHER))), 3),
            round(float(rng.uniform(-half, half)), 3),
        ),
        yaw=round(float(rng.uniform(-np.pi, np.pi)), 3),
        mass=round(float(rng.uniform(0.06, 0.25)), 3),
    )
    return parse_scene({"name": f"push_{seed}", "objects": [item]}, f"push scene {seed}")


def _to_push(scene: Scene) -> bool:
    """Whether arms at home find a plan to push the first object and then to grasp it, and none to grasp it at once."""
    config, robot, item = GraspConfig(), RobotDescription.load(), scene.objects[0]
    target = Detection(item.label, 1.0, se3.make(se3.rot_z(item.yaw), item.centre(scene.table)), np.array(item.size))
    context = GraspContext.of(config, scene.table, robot)

    def graspable(there: Detection) -> bool:
        grasps = propose(there, config, context.hand)
        return any(
            reaches(scene.table, PlanGrasp(arm, ways, (), (target_box(there, config),)))
            for arm in robot.arm_names
            for ways in (grasps, tuple(shorter(one) for one in grasps))
        )

    def pushable(end: Array) -> bool:
        ways = {arm: push_ways(target, end, config, closed_hand(robot, arm), context.hand) for arm in robot.arm_names}
        return any(
            reaches(scene.table, PlanGrasp(arm, behind, (), (target_box(target, config),)))
            for arm, behind in ways.items()
        )

    ends = [end for end in destinations(target, (), context) if end[0] < target.p_base[0]]
    return not graspable(target) and any(pushable(end) and graspable(standing_at(target, end)) for end in ends)


def reaches(table: Table, asked: PlanGrasp | PlanPlace) -> bool:
    """Whether an arm at home finds a plan for an object that is known without an error."""
    solver = arms_behind((), table)[asked.arm]
    try:
        plan_approach(solver, solver.start_state(_home()), approach_of(asked))
    except OpenArmError as error:
        if error.code not in NO_WAY:
            raise
        return False
    return True


def _home() -> Mapping[str, float]:
    robot = RobotDescription.load()
    state = dict.fromkeys(robot.joints, 0.0)
    for side in robot.arm_names:
        state |= robot.group_state(f"{side}_arm", GraspConfig().home_state)
    return state
