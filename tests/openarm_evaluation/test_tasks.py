# SPDX-License-Identifier: Apache-2.0
"""Tasks of campaigns: the same seeds give the same tasks in every version, and they follow the robot's folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import Scene
from openarm_evaluation.campaign.campaign import read_rows
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.tasks import suites, two_arms
from openarm_evaluation.campaign.tasks.faults import KINDS
from openarm_evaluation.campaign.tasks.suites import SUITES, make_task
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.tasks.things import THINGS
from tests.refusals import refused

#: Of the tasks of OpenArm v1, as figures in the docs have them.
KNOWN = {
    "nominal": "b20c6508cb10bbeb",
    "clutter": "d174116befcd15a0",
    "endurance": "18c75483273b8d77",
    "faults": "74dd7ff4f91ddee9",
    "handover": "45ff17aef914318b",
    "pairs": "88db651be7bc2133",
    "pairs_in_turn": "b7c091603ddf3f98",
    "orders": "937abd063cfacb6b",
}


def text(task: Task) -> str:
    """What a task asks of the robot."""
    plan = task.fault and {
        "name": task.fault.name,
        "parameters": task.fault.parameters,
        "when": task.fault.when,
        "until_attempt": task.fault.until_attempt,
    }
    told = {"labels": task.labels, "place": task.place, "posture": dict(task.posture), "kind": task.kind, "fault": plan}
    return json.dumps({"scene": task.scene.model_dump(mode="json"), **told}, sort_keys=True)


def digest(make: Callable[[int], str], seeds: int) -> str:
    return hashlib.sha256("".join(map(make, range(seeds))).encode()).hexdigest()[:16]


@pytest.mark.parametrize("suite", KNOWN)
def test_a_seed_gives_the_task_that_it_has_always_given(suite):
    seeds = 36 if suite == "faults" else 21  # of faults, each kind
    assert len(KINDS) <= 36
    assert digest(lambda seed: text(make_task(suite, seed)), seeds) == KNOWN[suite]


def test_an_object_to_push_is_drawn_at_the_same_place_by_a_seed():
    """Before what no arm can push is left out, which takes plans."""

    def first(seed: int) -> str:
        return two_arms._one_object(seed, np.random.default_rng([seed, 5])).model_dump_json()

    assert {*KNOWN, "push", "supports", *THINGS} == set(SUITES)
    assert digest(first, 21) == "e235d8f3dc89ed06"


@pytest.mark.long
@pytest.mark.parametrize("suite", ["nominal", "handover", "pairs", "clutter"])
def test_tasks_are_on_the_table_and_in_the_region_of_the_robot(nearer, suite):
    for seed in range(2):
        task = make_task(suite, seed)
        assert task.scene.table.top_z == 0.45
        places = [item.position[:2] for item in task.scene.objects] + [task.place] * (task.place is not None)
        for x, y in places:
            assert 0.15 <= x <= 0.35
            assert 0.05 <= abs(y) <= 0.45


def test_what_is_out_of_reach_is_past_the_region_of_the_robot(nearer):
    far = KINDS["out_of_reach"](make_task("nominal", 3), np.random.default_rng(0)).scene.objects[0]
    assert 0.35 + 0.15 <= far.position[0] <= 0.35 + 0.17
    assert 0.40 <= abs(far.position[1]) <= 0.43


def test_a_suite_of_two_arms_is_refused_for_a_robot_with_one(monkeypatch):
    robot = RobotDescription.load()
    single = replace(robot, name="single", arms={"right": robot.arms["right"]})
    monkeypatch.setattr(suites.RobotDescription, "load", lambda name="": single)
    refused(r"'pairs' needs two arms, robot 'single' has 1; suites: nominal, clutter", make_task, "pairs", 0)
    assert isinstance(make_task("nominal", 0).scene, Scene)


def test_rows_of_another_robot_are_not_gone_on_with(nearer, monkeypatch, tmp_path):
    options = CampaignOptions()
    monkeypatch.setenv(ROBOT, "openarm_v1")
    assert "--robot" not in options.command(3)
    of_old = {key: value for key, value in options.settings().items() if key != "robot"}
    (tmp_path / "settings.json").write_text(json.dumps(of_old))  # of a version with one robot
    assert read_rows(tmp_path, options) == []
    monkeypatch.setenv(ROBOT, nearer)
    refused(r"rows of another campaign \(robot was .?openarm_v1", read_rows, tmp_path, options)
    assert "--robot nearer" in options.command(3)
