# SPDX-License-Identifier: Apache-2.0
"""Hands that are not as drawn, in simulation: what happens before they are learned, and after."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.hands import with_drawn_hands, with_hands
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import UNKNOWN, Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_sim_bridge.world.hardware import drawn

#: The left hand stops 1.4 mm from closed, and opens to 36.6 mm.
SEED = 4


def task(width: float) -> Task:
    box = SceneObject(name="box", shape="box", size=(width, width, 0.07), color="red", position=(0.26, 0.22))
    return Task("nominal", 0, Scene(name="bench", objects=(box,)), ("red",))


def test_a_task_has_the_hands_of_its_turn_and_may_be_refused_what_they_cannot_take() -> None:
    options = CampaignOptions(hand_seeds=(SEED, 9), profile="ideal")
    for width, codes in ((0.05, (Code.OK,)), (0.076, (Code.OK, Code.TOO_WIDE))):
        found = with_drawn_hands(task(width), options)
        assert (found.hand_seed, found.codes) == (SEED, codes)
    assert with_drawn_hands(replace(task(0.05), seed=1), options).hand_seed == 9
    described = task(0.076)
    assert with_drawn_hands(described, CampaignOptions(profile="ideal")) is described


@pytest.mark.long
def test_a_hand_with_stops_of_its_own_is_refused_until_it_is_learned_and_then_works_with_the_width_it_has(
    tmp_path: Path,
) -> None:
    options = CampaignOptions(hand_seeds=(SEED,), profile="ideal")
    sets = options.graph_parameters()
    config = suite_config(sets)
    true = drawn(config.bridge.hardware.of_seed(None, SEED), RobotDescription.load()).fingers
    asked, hands = with_hands(task(0.05), options, tmp_path)
    for arm, reach in hands.items():
        assert reach.closed == pytest.approx(true[arm].closed, abs=2e-4)
        assert reach.opened == pytest.approx(true[arm].opened, abs=1e-3)
    assert with_hands(task(0.05), options, tmp_path)[1] == hands

    def row(task: Task, known: Known = UNKNOWN) -> dict[str, object]:
        return Trials(task, SimulatedSenses(sets=sets), config.grasp, known).run()

    before = row(asked)
    assert before["code"] in (Code.NOT_READY, Code.EXECUTION_FAILED)
    assert "openarm hardware learn-hand" in str(before["message"])
    after = row(asked, Known(hands=hands))
    assert after["placed"], after["message"]
    wide, _ = with_hands(task(0.076), options, tmp_path)
    assert wide.codes == (Code.OK, Code.TOO_WIDE)
    refused = row(wide, Known(hands=hands))
    widest = 2e3 * (hands["left"].opened - 0.005)
    assert (refused["code"], refused["as_expected"]) == (Code.TOO_WIDE, True)
    assert f"the hand grasps sides up to {widest:.0f} mm" in str(refused["message"])
