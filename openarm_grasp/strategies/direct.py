# SPDX-License-Identifier: Apache-2.0
"""One arm picks the object and places it: an arm that is near the object, or the far one when only that can."""

from __future__ import annotations

from dataclasses import replace

from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.requests.request import GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies.pick_and_place import pick_and_place


async def direct(task: Task) -> GraspOutcome:
    """Pick and place with the arms asked for; when they cannot place it, with the other arm if that can do it alone."""
    asked = task.request
    outcome = await pick_and_place(task, asked)
    if not task.may_go_on(outcome) or not task.findings.place_refused or asked.place is None:
        return outcome
    found = task.findings.need_sighting()
    task.note("no arm that was asked can do it alone; searching for another way")
    feasible = FeasibilityCheck(task.robot, task.context)
    for arm in task.robot.description.arm_names:
        if arm in task.findings.refusals:
            continue
        if await feasible.refusal(arm, found, asked.place, yaw=asked.place_yaw):
            continue
        why = f"the {arm} arm does it alone, from the other side"
        return await pick_and_place(task, replace(asked.about(found), arm=arm, why=why))
    return outcome
