# SPDX-License-Identifier: Apache-2.0
"""Push an object away from where it is, whether a hand can grasp it or not: what it hides or blocks comes free.

A plate that no hand can close on may lie on a spoon. Of lines that move the fewest other things the longest is taken.
That it has moved say the hand, which has gone along its line, and the camera. Base frame, m.
"""

from __future__ import annotations

from dataclasses import replace

from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.options import NO_WAY
from openarm_grasp.requests.confirm import PUSH, agree_once
from openarm_grasp.requests.request import Feasible, GraspOutcome
from openarm_grasp.requests.task import Task
from openarm_grasp.strategies.find import detect
from openarm_grasp.strategies.pick_and_place import succeeded
from openarm_grasp.strategies.pushing import carry_out_push, plan_sweep
from openarm_grasp.strategies.run import Run


async def aside(task: Task) -> GraspOutcome:
    """Push an object aside; in other directions, where it does not move."""
    request, robot = task.in_time(task.request), task.robot
    task.session.check_hands(robot, request)
    request.check(robot.description.arm_names)
    run = Run(task, request, None)
    robot.set_deadline(request.timeout)
    robot.set_speed(request.velocity_scale)
    try:
        found = await detect(run, f"asked to push {request.label or 'any object'!r} aside")
        outcome = await _pushed(run, found)
    except OpenArmError as error:
        outcome = run.answer(error.code, error.message)
    return run.end(outcome)


async def _pushed(run: Run, found: Sighting) -> GraspOutcome:
    """Push until the object has moved.

    Raises:
        OpenArmError: UNREACHABLE, when no push can be planned; what the robot raises.
    """
    task, config, avoid, text = run.task, run.config, list[Array](), ""
    for number in range(1, config.push.most + 1):
        try:
            planned = replace(await plan_sweep(task, found, avoid, config.push.aside, longest=True), why="aside")
        except OpenArmError as error:
            if number == 1 or error.code not in NO_WAY:
                raise
            raise OpenArmError(Code.PLACE_FAILED, f"{text}; then {error.message}") from error
        if run.request.dry_run:
            return run.answer(Code.OK, f"can be done: {planned}", Feasible(str(planned)))
        await agree_once(task, planned.arm, str(planned), PUSH, planned.plan, found)
        run.arm = planned.arm
        pushed, text, hand, camera = await carry_out_push(task, planned, found, number)
        task.displaced = "after the pushes"
        run.seen_at = pushed.target.p_base
        task.findings.sighting = run.findings.sighting = pushed
        if planned.moves(found.target, pushed.target) and hand.ok and camera.ok:
            return succeeded(run, text, hand=hand, camera=camera)
        avoid.append(planned.ahead)
        found = pushed
    raise OpenArmError(Code.PLACE_FAILED, f"{text}; it does not move aside")
