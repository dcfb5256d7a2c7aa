# SPDX-License-Identifier: Apache-2.0
"""Suites that a campaign can run: a name and a seed make a task."""

from __future__ import annotations

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_evaluation.campaign.tasks.faults import fault_task
from openarm_evaluation.campaign.tasks.supports import supports_task
from openarm_evaluation.campaign.tasks.task import Task, clutter, endurance, nominal
from openarm_evaluation.campaign.tasks.things import THINGS, heap_task, objects_task
from openarm_evaluation.campaign.tasks.two_arms import handover_task, in_turn_task, order_task, pair_task, push_task

#: Makers of tasks by the name of the suite.
SUITES = {
    "nominal": nominal,
    "clutter": clutter,
    "endurance": endurance,
    "faults": fault_task,
    "handover": handover_task,
    "push": push_task,
    "pairs": pair_task,
    "pairs_in_turn": in_turn_task,
    "orders": order_task,
    "objects": objects_task,
    "heap": heap_task,
    "supports": supports_task,
}
#: Those that two arms share, or whose objects stand between two arms.
OF_TWO_ARMS = ("handover", "push", "pairs", "pairs_in_turn", "orders")


def make_task(set_name: str, seed: int, objects: str = "") -> Task:
    """Make the task of a suite and a seed, for this process's robot.

    Args:
        set_name: Name of the suite.
        seed: Seed of the task.
        objects: Objects that suites of any shape take, same as for `things.object_sources`.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the suites; a suite of two arms, for a robot with one.
    """
    if set_name not in SUITES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no suite {set_name!r}; suites: {', '.join(SUITES)}")
    robot = RobotDescription.load()
    if set_name in OF_TWO_ARMS and len(robot.arm_names) < 2:
        mine = ", ".join(name for name in SUITES if name not in OF_TWO_ARMS)
        text = f"suite {set_name!r} needs two arms, robot {robot.name!r} has {len(robot.arm_names)}; suites: {mine}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    if set_name in THINGS:
        return objects_task(seed, objects) if set_name == "objects" else heap_task(seed, objects)
    if objects:
        text = f"--objects is of the suites {', '.join(THINGS)}, not of {set_name!r}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    return SUITES[set_name](seed)
