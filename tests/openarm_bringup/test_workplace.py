# SPDX-License-Identifier: Apache-2.0
"""The workplace of a robot that is new: what is written into its folder, and what stays."""

from __future__ import annotations

import shutil

import pytest
import yaml

from openarm_bringup.commands.model import work
from openarm_common.camera.cameras import load_cameras
from openarm_common.resources import models_dir
from openarm_common.robot.folder import ROBOT, read_folder
from openarm_common.scene.scene import random_scene
from openarm_sim_bridge.drafting.check import folder_faults
from openarm_sim_bridge.drafting.semantics import read_source


@pytest.fixture
def panda(tmp_path, monkeypatch):
    """The panda without all that is found."""
    folder = shutil.copytree(models_dir() / "robots" / "panda", tmp_path / "panda2")
    robot = yaml.safe_load((folder / "robot.yaml").read_text())
    del robot["work"], robot["cameras"]
    (folder / "robot.yaml").write_text("# of mine\n" + yaml.safe_dump(robot))
    (folder / "cameras.yaml").unlink()
    postures = {"home": {"panda": [0, -0.785, 0, -2.356, 0, 1.571, 0.785]}}
    source = yaml.safe_load((folder / "semantics.yaml").read_text()) | {"postures": postures}
    (folder / "semantics.yaml").write_text(yaml.safe_dump(source))
    monkeypatch.setenv(ROBOT, str(folder))
    return folder


def test_a_workplace_is_found_and_a_table_that_is_there_stays(panda):
    message = work(str(panda)).message
    assert message.startswith("work: objects stand at x ")
    assert message.endswith(" m, where the arms were found to grasp from above")
    found = read_folder(panda)
    assert found.work is not None
    assert found.work.table.top_z == 0.45  # as high as its base stands
    assert found.work.region.x[0] > found.work.table.x[0] > found.work.least_x > 0.1
    assert found.work.region.abs_y[1] >= 0.3
    assert list(load_cameras()) == ["overhead", "wrist", "spectator"]
    assert set(read_source(panda).postures) == {"home", "over_table", "wrist_look"}
    assert folder_faults(panda) == []
    assert random_scene(3).objects
    # another table, by hand
    text = (panda / "robot.yaml").read_text()
    assert text.startswith("# of mine\n")
    (panda / "robot.yaml").write_text(text.replace("top_z: 0.45", "top_z: 0.55"))
    (panda / "cameras.yaml").write_text("# mine, too\n" + (panda / "cameras.yaml").read_text())
    work(str(panda))
    again = read_folder(panda)
    assert again.work is not None
    assert again.work.table == found.work.table.at(0.55)
    assert (panda / "robot.yaml").read_text().count("work:") == 1
    assert (panda / "cameras.yaml").read_text().startswith("# mine, too\n")


def test_what_keeps_a_workplace_from_being_found_is_said(panda):
    robot = yaml.safe_load((panda / "robot.yaml").read_text())
    without = {key: value for key, value in robot.items() if key != "hand"}
    (panda / "robot.yaml").write_text(yaml.safe_dump(without))
    assert work(str(panda)).message == f"work: needs `hand` in robot.yaml, then `openarm model work {panda}`"
    robot["work"] = {
        "table": {"top_z": 0.45, "x": [1.5, 1.9], "y": [-0.5, 0.5], "thickness": 0.04},
        "least_x": 0.2,
        "region": {"x": [1.6, 1.7], "abs_y": [0.0, 0.1]},
    }
    (panda / "robot.yaml").write_text(yaml.safe_dump(robot))
    assert work(str(panda)).message.startswith(
        "work: no arm grasps from above all over any 0.04 m of the table, 0.45 m high; `stand: [X, Y, Z]` in --edits"
    )
