# SPDX-License-Identifier: Apache-2.0
"""Suites that a campaign can run: a name and a seed make a task."""

from __future__ import annotations

from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign.tasks.faults import fault_task
from openarm_evaluation.campaign.tasks.task import Task, clutter, endurance, nominal
from openarm_evaluation.campaign.tasks.two_arms import handover_task, in_turn_task, pair_task, push_task

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
}


def make_task(set_name: str, seed: int) -> Task:
    """Make the task of a suite and a seed.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the suites.
    """
    if set_name not in SUITES:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no suite {set_name!r}; suites: {', '.join(SUITES)}")
    return SUITES[set_name](seed)
