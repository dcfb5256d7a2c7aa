# SPDX-License-Identifier: Apache-2.0
"""Every kind of fault that a campaign injects, and how the strategies end that saw it."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.faults import KINDS
from openarm_evaluation.campaign.tasks.suites import make_task
from tests.openarm_grasp.recorded import Recordings

#: The map is renewed less often, and two attempts are enough: every kind takes a second or two to record.
QUICK = SimulatedSenses(depth_noise=False, sets=("octomap.period=2.0", "grasp.limits.max_attempts=2"))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.requirement("N-03", "N-05")
def test_a_fault_ends_with_a_recovery_or_the_right_code(recorded: Recordings, kind: str) -> None:
    task = make_task("faults", list(KINDS).index(kind))
    assert task.kind == kind
    config = suite_config(QUICK.parameters()).grasp
    robot = recorded(task.scene, clouds=False, senses=QUICK, config=config, task=task)
    if robot.trials is not None:
        robot.trials._begin_fault("")
    (label,) = task.labels
    outcome = robot.ask(label, arm=task.arm, place=task.place)
    assert outcome.code in task.codes, f"{outcome.code}: {outcome.message}"
    if outcome.success:
        robot.pass_time(0.5)
        ends = [robot.pose(item.name)[:2, 3] for item in task.scene.objects if item.label == label]
        assert min(np.linalg.norm(end - outcome.place_position[:2]) for end in ends) < 0.02
    if robot.trials is not None:
        assert robot.trials.injected == (task.fault is not None)
    assert ("by fault injection" in robot.said) == (kind == "plan_fails_once")
    again = kind.startswith(("nudged", "gripper_stuck_once"))
    assert not again or (outcome.attempts == 2 and outcome.code is Code.OK)
