# SPDX-License-Identifier: Apache-2.0
"""Evaluation: campaigns judged by ground truth, the demonstration, data and training of the network detector.

Example:
    >>> from pathlib import Path
    >>> from openarm_evaluation import CampaignOptions, run_campaign
    >>> campaign = run_campaign(CampaignOptions("nominal", seeds=(0, 1, 2)), Path("runs/three"))  # doctest: +SKIP
    >>> [row["outcome"] for row in campaign.rows]  # doctest: +SKIP
    ['placed', 'placed', 'placed']

A campaign runs in this process, on several or on several machines; with `rows_of_graph` as its runner, through the node
graph.
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_evaluation.campaign.agree import compare as compare
    from openarm_evaluation.campaign.campaign import Campaign as Campaign
    from openarm_evaluation.campaign.campaign import run_campaign as run_campaign
    from openarm_evaluation.campaign.options import CampaignOptions as CampaignOptions
    from openarm_evaluation.campaign.tasks.suites import make_task as make_task
    from openarm_evaluation.campaign.tasks.task import Task as Task
    from openarm_evaluation.demo.demo import run_demo as run_demo
    from openarm_evaluation.demo.options import DemoOptions as DemoOptions
    from openarm_evaluation.judging.judge import JudgeConfig as JudgeConfig
    from openarm_evaluation.judging.judge import Verdict as Verdict
    from openarm_evaluation.judging.judge import judge as judge
    from openarm_evaluation.judging.statistics import summarise as summarise

__getattr__, __dir__ = attach(__name__, __file__)
