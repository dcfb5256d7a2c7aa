# SPDX-License-Identifier: Apache-2.0
"""Hands of a campaign's robot: those of each draw are learned once, by the suite itself, in this process."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.learned import LearnedStore, StoredHands, keep_hand
from openarm_common.robot.zeros import HandReach
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.in_process_robot import InProcessRobot
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import SimRobot, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_grasp.context import GraspContext
from openarm_grasp.robot.learn import learn_hand
from openarm_grasp.robot.skills import Skills
from openarm_sim_bridge.world.hardware import drawn


def with_drawn_hands(task: Task, options: CampaignOptions) -> Task:
    """The task with the hands of one of the seeds, each in turn; without seeds of hands they are as described.

    What is too wide for the hands that may reach it, by the truth, may be refused for that.
    """
    if not options.hand_seeds:
        return task
    task = replace(task, hand_seed=options.hand_seeds[task.seed % len(options.hand_seeds)])
    robot, config = RobotDescription.load(), suite_config(options.graph_parameters())
    stops = drawn(config.bridge.hardware.of_seed(None, task.hand_seed), robot.described).fingers
    true = robot.with_hands({arm: HandReach(closed=one.closed, opened=one.opened) for arm, one in stops.items()})
    context = GraspContext.of(config.grasp, task.scene.table, true)
    for item in task.scene.objects:
        arms = context.arm_order(task.arm, item.position[1])
        asked = task.graspable or item.label in task.labels
        if asked and min(item.size[:2]) > max(context.parts(arm).max_width for arm in arms):
            return replace(task, codes=(*task.codes, Code.TOO_WIDE))
    return task


def with_hands(task: Task, options: CampaignOptions, folder: Path) -> tuple[Task, Mapping[str, HandReach]]:
    """The task as `with_drawn_hands`, and what was learned of its hands, by arm.

    Args:
        task: The task.
        options: Options of the campaign.
        folder: Folder of learned hands; those that it lacks are learned.
    """
    task = with_drawn_hands(task, options)
    if task.hand_seed is None:
        return task, {}
    store, name, sets = LearnedStore(folder, StoredHands), f"hand_seed_{task.hand_seed}", options.graph_parameters()
    known, config = store.in_use(name).hands, suite_config(sets)
    if missing := [arm for arm in RobotDescription.load().hands if arm not in known]:
        senses = SimulatedSenses(sets=sets)
        robot = SimRobot(load_scene("empty"), senses, dynamics_seed=1, hand_seed=task.hand_seed)
        link = InProcessRobot(robot, config.grasp)
        for arm in missing:
            reach = link.run(learn_hand(Skills(link, config.grasp), arm, config.grasp.timing.settle_limit))
            keep_hand(folder, name, arm, reach)
        known = store.in_use(name).hands
    return task, known
