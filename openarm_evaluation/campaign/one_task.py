# SPDX-License-Identifier: Apache-2.0
"""One task of a campaign, whatever becomes of it: in this process, in another, or on another machine."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from openarm_evaluation.campaign.options import CampaignOptions, Row
from openarm_evaluation.campaign.tasks.suites import make_task


def run_one(options: CampaignOptions, seed: int, folder: Path) -> Row:
    """Run one task in this process and return its row, whatever happens."""
    from openarm_evaluation.campaign.mounts import with_mounts
    from openarm_evaluation.campaign.parameters import suite_config
    from openarm_evaluation.campaign.robot import SimulatedSenses
    from openarm_evaluation.campaign.trial import Trials, crashed_row

    task = make_task(options.set_name, seed)
    mounts: Mapping[str, Any] = {}
    try:
        if options.mount_seeds:
            task, mounts = with_mounts(task, options.mount_seeds, folder / "mounts")
        trials = Trials(
            task,
            SimulatedSenses(depth_noise=options.noise, detector=options.detector, sets=options.graph_parameters()),
            suite_config(options.graph_parameters()).grasp,
            mounts=mounts,
            folder=folder / "failures" / str(seed),
            again=options.command(seed),
        )
        return trials.run()
    except Exception as error:  # one task must not end a campaign of a thousand; its row says what happened
        return {**crashed_row(task, error), "again": options.command(seed)}
