# SPDX-License-Identifier: Apache-2.0
"""Another height: a robot whose arms stand on a lift goes where one of them can grasp the object.

The planner is asked for the grasp at other heights before anything moves, the nearest to the present one first; there
the object is observed and picked as ever. Base frame, m.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.feasibility import FeasibilityCheck
from openarm_grasp.planning.options import refusals
from openarm_grasp.requests.confirm import GRASP, agree_once
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.robot.interface import Planned
from openarm_grasp.strategies.pick_and_place import pick_and_place

#: A height that is nearer to the present one is no other, m.
_SAME = 0.005


@dataclass(frozen=True)
class Height:
    """A height at which a grasp was planned.

    Attributes:
        position: Position of the lift, m.
        present: Present position, m.
        arm: Arm that grasps there.
        plan: Plan of the grasp.
    """

    position: float
    present: float
    arm: str
    plan: Planned

    def __str__(self) -> str:
        """Sentence for the status."""
        return f"the lift goes from {self.present:.3f} to {self.position:.3f} m, where the {self.arm} arm reaches it"


async def height(task: Task) -> GraspOutcome | None:
    """Move the lift to another height and pick there, when no arm can do it at the present one."""
    refused = task.outcome
    if refused is None or task.robot.description.lift is None:
        return None
    found, faults = task.findings.need_sighting(), list[str]()
    for position in heights(task):
        with refusals(faults, f"at {position:.3f} m: "):
            await task.robot.move_lift(position, plan_only=True)  # milliseconds, where a grasp takes seconds
            planned = await _planned(task, found, position)
            if task.request.dry_run:
                return replace(refused, code=Code.OK, message=f"can be done: {planned}", proof=Feasible(str(planned)))
            await agree_once(task, planned.arm, str(planned), GRASP, planned.plan, found)
            task.note(str(planned))
            await task.robot.move_lift(position)
            why = f"the lift is at {position:.3f} m"
            outcome = await pick_and_place(task, replace(task.request.about(found), why=why))
            if not task.may_go_on(outcome):
                return outcome
            faults.append(f"at {position:.3f} m: {outcome.message}")
    why = faults[0] if faults else "it has no other height"
    text = f"nor can it at another height of the lift ({len(faults)} tried): {why}"
    raise OpenArmError(refused.code, text)


def heights(task: Task) -> Iterator[float]:
    """Give positions of the lift over its whole travel, the nearest to the present one first, m."""
    description, step = task.robot.description, task.context.config.height.step
    if description.lift is None:
        return
    joint, present = description.joint(description.lift.joint), task.robot.lift_position()
    count = int(np.ceil((joint.upper - joint.lower) / step))
    for position in sorted(np.linspace(joint.lower, joint.upper, count + 1), key=lambda p: abs(p - present)):
        if abs(position - present) > _SAME:
            yield float(position)


async def _planned(task: Task, found: Sighting, position: float) -> Height:
    """Plan the grasp at a height, with any arm.

    Raises:
        OpenArmError: One of `NO_WAY`; what the robot raises.
    """
    feasible, faults = FeasibilityCheck(task.robot, task.context), list[str]()
    for arm in task.context.arm_order("auto", float(found.target.p_base[1])):
        with refusals(faults):
            plan = await feasible.grasp(arm, found, at_height=position)
            return Height(position, task.robot.lift_position(), arm, plan)
    raise OpenArmError(Code.UNREACHABLE, faults[-1])
