# SPDX-License-Identifier: Apache-2.0
"""Draws that end: what fits is returned, and where nothing does it is said what to change."""

from __future__ import annotations

import shutil
from itertools import count

import pytest
import yaml

from openarm_common.draws import first_fit, until
from openarm_common.errors import Code
from openarm_common.resources import models_dir
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import SPACING, random_scene
from openarm_evaluation.campaign.tasks import two_arms
from openarm_evaluation.campaign.tasks.suites import make_task
from tests.refusals import refused


def test_the_first_draw_that_fits_is_returned_and_after_the_last_it_is_said_what_to_change():
    numbers = count()
    assert first_fit("seed 3: a number above 4", "draw more", lambda: n if (n := next(numbers)) > 4 else None) == 5
    error = refused(None, first_fit, "seed 3: a number", "draw more", lambda: None, 7)
    assert error.message == "seed 3: a number: none of 7 draws fits; draw more"
    assert error.code is Code.INVALID_ARGUMENT


def test_draws_go_on_until_there_are_enough_and_end_where_too_few_fit():
    found: list[int] = []
    for number in until(lambda: len(found) == 2, "even numbers", "draw more", 4):
        if number % 2 == 0:
            found.append(number)
    assert found == [0, 2]
    words = "even numbers: too few of 4 draws fit; draw more"
    refused(words, lambda: list(until(lambda: False, "even numbers", "draw more", 4)))


@pytest.fixture
def narrow(tmp_path, monkeypatch):
    """A robot whose region has room for two objects."""
    folder = shutil.copytree(
        models_dir() / "robots" / "panda", tmp_path / "narrow", ignore=shutil.ignore_patterns("meshes")
    )
    robot = yaml.safe_load((folder / "robot.yaml").read_text())
    robot["work"]["region"] = {"x": [0.4, 0.42], "abs_y": [0.06, 0.07]}
    (folder / "robot.yaml").write_text(yaml.safe_dump(robot))
    monkeypatch.setenv(ROBOT, str(folder))


def test_a_random_scene_has_as_many_objects_as_the_region_has_room_for(narrow):
    found = [len(random_scene(seed).objects) for seed in range(12)]
    assert set(found) == {1, 2}
    words = (
        f"random scene 1: a place for object 3 of 4, {SPACING:g} m from the others: none of 1000 draws fits; take fewer"
    )
    refused(words, random_scene, 1, 4)


def test_a_suite_whose_scenes_do_not_fit_a_robot_says_so(monkeypatch):
    monkeypatch.setenv(ROBOT, "openarm_v2")
    monkeypatch.setattr(two_arms, "_to_push", lambda scene: False)
    words = "push 7: a box of 40 to 70 mm between the arms, x from 0.35 m on, to be pushed before it is"
    error = refused(words, make_task, "push", 7)
    assert error.message.endswith("enlarge work.region of robot.yaml to all that the arms grasp, or its table")
    monkeypatch.setattr(two_arms, "random_scene", lambda seed, count: random_scene(3, count=1))
    refused("pairs 7: an object on either side: none of 1000 draws fits; enlarge work.region", make_task, "pairs", 7)


def test_what_is_to_be_pushed_can_be_pushed_and_not_grasped(monkeypatch):
    monkeypatch.setenv(ROBOT, "openarm_v2")
    scene = make_task("push", 5).scene

    def to_push(x: float) -> bool:
        item = scene.objects[0].model_copy(update={"position": (x, scene.objects[0].position[1])})
        return two_arms._to_push(scene.model_copy(update={"objects": (item,)}))

    assert to_push(scene.objects[0].position[0])
    assert not to_push(0.30), "an arm grasps it there"
    assert not to_push(0.70), "no arm comes there"
