# SPDX-License-Identifier: Apache-2.0
"""Why each way to grasp was chosen or not: what the answer says, in a scripted world and by the planner itself."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import isnan, nan
from typing import Any

import numpy as np
import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.scene.scene import Scene, SceneObject
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.verdicts import Verdict
from openarm_grasp.planning.options import NoWayError, Option
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.robot.interface import Planned
from openarm_grasp.strategies.registry import carry_out


@pytest.fixture
def asked(worlds: Callable[..., Any], box: Callable[..., Any]) -> Callable[..., tuple[Option, ...]]:
    """Asks a scripted planner for a dry run; it answers each plan with what comes next."""

    def ask(*answers: Planned | OpenArmError, **changes: Any) -> tuple[Option, ...]:
        world = worlds(replace(box("red", 0.26, -0.2), **changes))
        world.plans = list(answers)
        return world.grasp("red", arm="right", dry_run=True).options

    return ask


def by_id(options: tuple[Option, ...]) -> dict[str, Option]:
    return {option.id: option for option in options}


def no_way(code: Code, **refusals: str) -> NoWayError:
    why = {id.replace("_", "/"): Verdict(code, reason) for id, reason in refusals.items()}
    return NoWayError(code, "no way", why)


def test_the_answer_has_every_way_with_its_score_and_its_fate(asked) -> None:
    refusals = {"red/x-/tilt0": Verdict(Code.IN_COLLISION, "red/x-/tilt0: on the approach it meets 'blue'")}
    options = asked(Planned(0, "", "", "", refusals, (0.3, 0.2, *(nan,) * 26)))
    assert len(options) == 28
    assert [o.score for o in options] == sorted((o.score for o in options), reverse=True)
    assert all(o.score == pytest.approx(sum(o.parts.values())) for o in options)
    found = by_id(options)
    chosen = found["red/x+/tilt0"]
    assert (chosen.arm, chosen.code, chosen.message, chosen.limit_margin) == ("right", Code.OK, "chosen", 0.3)
    assert found["red/x-/tilt0"].code is Code.IN_COLLISION
    assert found["red/x-/tilt0"].message == "on the approach it meets 'blue'"
    assert (found["red/y+/tilt45/lean-"].code, isnan(found["red/y+/tilt45/lean-"].limit_margin)) == ("", True)


def test_a_refusal_names_every_way(asked) -> None:
    refused = no_way(Code.UNREACHABLE, **{"red_x+_tilt0": "20 mm short"})
    found = by_id(asked(refused, refused, refused, refused))
    assert (found["red/x+/tilt0"].code, found["red/x+/tilt0"].message) == (Code.UNREACHABLE, "20 mm short")


def test_an_edge_that_is_too_wide_is_reported(asked) -> None:
    found = by_id(asked(size=np.array([0.05, 0.09, 0.05])))
    assert len(found) == 15
    assert (found["red/y"].code, found["red/y"].message) == (
        Code.TOO_WIDE,
        "90 mm wide; the hand grasps sides up to 78 mm",
    )


def test_what_could_be_grasped_but_not_placed_says_so_and_those_that_share_its_fate(asked) -> None:
    found = by_id(asked(Planned(0, "", "", ""), no_way(Code.UNREACHABLE)))
    assert found["red/x+/tilt0"].code is Code.UNREACHABLE
    assert found["red/x+/tilt0"].message == "it could grasp, but not place: no way"
    assert found["red/y-/tilt0"].message == "it would stand at the place as red/x+/tilt0, and not do"
    assert sum(o.code is Code.OK for o in found.values()) == 1


@pytest.mark.long
def test_the_planner_says_what_became_of_each_and_how_near_to_a_limit() -> None:
    """A wall next to the object: hands that lean over it are refused by its name."""
    box = SceneObject(name="red_box", shape="box", size=(0.045, 0.06, 0.06), color="red", position=(0.26, -0.2))
    wall = replace_at(box, "blue_wall", "blue", (0.26, -0.29))
    scene = Scene(name="options", objects=(box, wall))
    config = GraspConfig()
    trials = Trials(Task("nominal", 1, scene, ()), SimulatedSenses(depth_noise=False), config)
    trials.robot.pass_time(0.3)
    request = GraspRequest("red", arm="right", dry_run=True)
    outcome = trials.link.run(carry_out(trials.grasp_task(request)))
    assert outcome.success, outcome.message
    (chosen,) = (o for o in outcome.options if o.code is Code.OK)
    assert f"grasp {chosen.id} with the right arm" in outcome.message
    assert 0.05 <= chosen.limit_margin < 1.6
    assert all(o.message for o in outcome.options)
    better = [o for o in outcome.options if o.score > chosen.score + 0.05]
    assert all(o.code != "" for o in better)  # nothing that is preferred was left out


def replace_at(item: SceneObject, name: str, color: str, position: tuple[float, float]) -> SceneObject:
    return item.model_copy(update={"name": name, "color": color, "position": position})
