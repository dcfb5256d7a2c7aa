# SPDX-License-Identifier: Apache-2.0
"""A robot is a folder: what is in it, and what is said when something is wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import yaml

from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription


@pytest.fixture
def robots(tmp_path, monkeypatch) -> Path:
    """A folder of models with one robot, `mine`, a copy of OpenArm v1."""
    mine = tmp_path / "robots" / "mine"
    shutil.copytree(models_dir() / "robots" / "openarm_v1", mine)
    monkeypatch.setattr(folder, "models_dir", lambda: tmp_path)
    return mine


def altered(mine: Path, **changes: object) -> None:
    path = mine / "robot.yaml"
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))


def test_a_robot_of_another_name_is_read_from_its_folder(robots, monkeypatch):
    assert folder.robot_names() == ("mine",)
    robot = RobotDescription.from_folder("mine")
    assert robot.name == "mine"
    assert robot.arm_names == ("left", "right")
    monkeypatch.setenv(folder.ROBOT, "mine")
    assert RobotDescription.load() is RobotDescription.load("mine")


def test_a_robot_that_is_not_there_is_refused_with_those_that_are(robots):
    with pytest.raises(OpenArmError, match="no robot 'other'; robots: mine") as error:
        RobotDescription.from_folder("other")
    assert error.value.code is Code.INVALID_ARGUMENT


def test_all_names_that_the_description_lacks_are_said_at_once(robots):
    text = (robots / "robot.yaml").read_text().replace("openarm_left_joint7", "joint_x")
    (robots / "robot.yaml").write_text(text.replace("openarm_right_hand_tcp", "tip"))
    with pytest.raises(OpenArmError, match=r"arms\.left: no joint 'joint_x'.*arms\.right: no link 'tip'") as error:
        RobotDescription.from_folder("mine")
    assert error.value.code is Code.CONFIG_INVALID


def test_signs_of_the_mirror_are_as_many_as_joints(robots):
    altered(robots, mirror=[1, -1])
    with pytest.raises(OpenArmError, match="mirror has 2 signs, arm left has 7 joints"):
        RobotDescription.from_folder("mine")


def test_an_arm_that_the_robot_lacks_is_refused_with_those_it_has():
    with pytest.raises(OpenArmError, match="no arm 'third' in robot 'openarm_v1'; arms: left, right"):
        RobotDescription.load().arm("third")


def test_arms_that_are_no_mirror_images_are_not_mirrored(robots):
    altered(robots, mirror=[])
    with pytest.raises(OpenArmError, match="no mirror images"):
        RobotDescription.from_folder("mine").mirrored([0.0] * 7)
