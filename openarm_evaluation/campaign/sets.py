# SPDX-License-Identifier: Apache-2.0
"""The sets that a campaign can run: from a name and a seed comes a task."""

from __future__ import annotations

from openarm_common.errors import Code, OpenArmError
from openarm_evaluation.campaign import tasks
from openarm_evaluation.campaign.faults import fault_task
from openarm_evaluation.campaign.tasks import Task
from openarm_evaluation.campaign.two_arms import handover_task, in_turn_task, pair_task, push_task

#: Makers of tasks by the name of the set.
SETS = {
    "nominal": tasks.nominal,
    "clutter": tasks.clutter,
    "endurance": tasks.endurance,
    "faults": fault_task,
    "handover": handover_task,
    "push": push_task,
    "pairs": pair_task,
    "pairs_in_turn": in_turn_task,
}


def make_task(set_name: str, seed: int) -> Task:
    """Make the task of a set and a seed.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the sets.
    """
    if set_name not in SETS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no set {set_name!r}; sets: {', '.join(SETS)}")
    return SETS[set_name](seed)
