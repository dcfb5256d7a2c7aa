# SPDX-License-Identifier: Apache-2.0
"""A robot is a folder: what is in it, and what is said when something is wrong."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
import yaml

from openarm_calibration.store.store import places
from openarm_common.camera.cameras import load_cameras
from openarm_common.errors import Code
from openarm_common.motors.wiring import load_wiring
from openarm_common.resources import models_dir
from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription
from openarm_common.scene import scene
from openarm_common.scene.scene import Scene, load_scene, parse_scene
from openarm_motion.config import MotionConfig
from openarm_motion.planning.moves import RequestBoxes, to_joints
from openarm_motion.service.motion_service import make_arms
from openarm_sim_bridge.drafting.check import folder_faults
from tests.refusals import refused, refuses


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


def test_a_robot_that_is_not_there_is_refused_with_those_that_are(robots):
    with refuses(Code.INVALID_ARGUMENT, "no robot 'other'; robots: mine"):
        RobotDescription.from_folder("other")


def test_all_names_that_the_description_lacks_are_said_at_once(robots):
    text = (robots / "robot.yaml").read_text().replace("openarm_left_joint7", "joint_x")
    (robots / "robot.yaml").write_text(text.replace("openarm_right_hand_tcp", "tip"))
    with refuses(Code.CONFIG_INVALID, r"arms\.left: no joint 'joint_x'.*arms\.right: no link 'tip'"):
        RobotDescription.from_folder("mine")


def test_signs_of_the_mirror_are_as_many_as_joints(robots):
    altered(robots, mirror=[1, -1])
    refused("mirror has 2 signs, arm left has 7 joints", RobotDescription.from_folder, "mine")


def test_cameras_are_those_of_the_robot_of_the_process(robots, monkeypatch):
    monkeypatch.setenv(folder.ROBOT, "mine")
    assert list(load_cameras()) == ["overhead", "wrist", "spectator"]
    text = (robots / "cameras.yaml").read_text().replace("name: overhead", "name: above")
    (robots / "mine.yaml").write_text(text)
    altered(robots, cameras="mine.yaml")
    assert list(load_cameras()) == ["above", "wrist", "spectator"]
    altered(robots, cameras="")
    assert load_cameras() == {}


def test_an_arm_that_the_robot_lacks_is_refused_with_those_it_has():
    refused("no arm 'third' in robot 'openarm_v1'; arms: left, right", RobotDescription.load().arm, "third")


@pytest.mark.long
def test_arms_that_are_no_mirror_images_are_not_mirrored(robots):
    altered(robots, mirror=[])
    refused("no mirror images", RobotDescription.from_folder("mine").mirrored, [0.0] * 7)


def test_the_table_of_a_scene_is_that_of_the_robot_where_the_scene_says_nothing_else(nearer, monkeypatch):
    bench = parse_scene({"table": {"x": [0.2, 0.9]}}, "bench.yaml")
    assert (bench.table.top_z, bench.table.x, bench.table.thickness) == (0.45, (0.2, 0.9), 0.04)
    assert Scene().table == folder.robot_work().table
    monkeypatch.setenv(folder.ROBOT, "openarm_v1")
    assert Scene().table.top_z == 0.40


def test_a_scene_in_the_folder_of_the_robot_goes_before_one_of_all_robots(nearer, monkeypatch):
    own = scene.models_dir() / "robots" / "nearer" / "scenes"
    assert not own.exists()
    common = load_scene("empty")
    monkeypatch.setattr(scene, "models_dir", folder.models_dir)
    own = folder.models_dir() / "robots" / "nearer" / "scenes"
    own.mkdir()
    (own / "empty.yaml").write_text("table: {top_z: 0.5}")
    assert (load_scene("empty").table.top_z, common.table.top_z) == (0.5, 0.45)
    refused(
        "calibration, calibration_overhead, calibration_overhead_left_arm, calibration_wrist, empty, random",
        load_scene,
        "demo",
    )


def test_a_robot_that_does_not_say_where_it_works_has_no_scenes(robots, monkeypatch):
    monkeypatch.setenv(folder.ROBOT, "mine")
    altered(robots, work=None)
    assert refused(r"robot\.yaml:work: missing", Scene).code is Code.CONFIG_INVALID


def test_a_table_that_stands_in_the_robot_is_refused(robots):
    work = yaml.safe_load((robots / "robot.yaml").read_text())["work"]
    altered(robots, work=work | {"least_x": 0.2})
    refused(r"stand in the robot: x is 0\.11, expected at least 0\.2", folder.load_folder, "mine")


@pytest.mark.requirement("R-06")
def test_a_robot_may_be_a_folder_anywhere(tmp_path, monkeypatch):
    """By its path it is a robot as any other, called as its folder: description, scenes, calibration, plans."""
    monkeypatch.setenv(folder.ROBOT, "")
    mine = shutil.copytree(models_dir() / "robots" / "panda", tmp_path / "mine")
    folder.choose_robot(str(mine))
    assert (folder.robot_name(), folder.robot_folder(), folder.robot_source()) == ("mine", mine, str(mine))
    robot = RobotDescription.load()
    assert robot.name == "mine"
    assert folder_faults(mine) == []
    assert load_scene("demo").table.top_z == 0.45
    assert {store.folder for store in places(tmp_path, 1)} >= {mine / "calibration" / "mount_seed_1"}
    arm = make_arms(MotionConfig(), robot, [])["panda"]
    home, ready = (robot.group_state("panda_arm", name) for name in ("home", "ready"))
    now = arm.start_state(home | {robot.finger_joint("panda"): 0.0})
    assert to_joints(arm, now, np.array([ready[name] for name in arm.names]), RequestBoxes()).duration > 0.1
    refused(r"or the path of a folder with a robot\.yaml", folder.choose_robot, str(tmp_path))


def test_motors_on_can_are_those_that_are_simulated(monkeypatch):
    """Gains of `hardware.yaml` are those of `robot.yaml`; a robot with the motors of another names its file."""
    found = {}
    for name in ("openarm_v1", "openarm_v2", "openarm_v2_cell"):
        monkeypatch.setenv(folder.ROBOT, name)
        found[name], motors = load_wiring(), folder.load_folder(name)[1].motors
        assert motors is not None
        assert found[name].joints.stiffness == motors.gains.stiffness
        assert found[name].joints.damping == motors.gains.damping
    assert found["openarm_v2_cell"] == found["openarm_v2"]
    monkeypatch.setenv(folder.ROBOT, "panda")
    refused(r"hardware\.yaml: missing", load_wiring)
