# SPDX-License-Identifier: Apache-2.0
"""`openarm model`: a robot drafted, checked, and its SRDF written."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from openarm_common.robot import folder
from openarm_common.robot.description import RobotDescription
from tests.openarm_bringup.commands import answer_of

MJCF = """<mujoco><worldbody><geom type="box" size="0.1 0.1 0.1"/>
  <body name="a" pos="0 0 0.2"><joint name="j" range="0 1"/><geom type="box" size="0.02 0.02 0.02" mass="1"/>
    <body name="b" pos="0 0 0.1"><joint name="g" range="0 1" axis="1 0 0"/><geom type="sphere" size="0.01" mass="1"/>
    </body></body></worldbody></mujoco>"""


@pytest.fixture
def robots(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of robots that `openarm model` works on."""
    (tmp_path / "robots").mkdir()
    monkeypatch.setattr(folder, "models_dir", lambda: tmp_path)
    (tmp_path / "r.xml").write_text(MJCF)
    return tmp_path / "robots"


def test_a_robot_is_drafted_checked_and_its_srdf_written_anew(robots, tmp_path, capsys):
    new = ("new", "mine", "--mjcf", str(tmp_path / "r.xml"), "--out", str(robots), "--samples", "50")
    code, answer = answer_of(capsys, "model", *new, "--arm", "one=base_link:a")
    assert (code, answer["success"]) == (0, True)
    assert any("velocity" in fault for fault in answer["faults"])
    code, answer = answer_of(capsys, "model", "check", "mine")
    assert (code, answer["code"]) == (1, "CONFIG_INVALID")
    assert answer["message"] == f"mine: {len(answer['faults'])} faults"
    path = robots / "mine" / "semantics.yaml"
    source = yaml.safe_load(path.read_text())
    assert source["samples"] == 50
    path.write_text(yaml.safe_dump(source | {"postures": {"home": {"one": [0.5]}}}))
    assert answer_of(capsys, "model", "semantics", "mine")[0] == 0
    assert RobotDescription.from_folder("mine").group_state("one_arm", "home") == {"j": 0.5}


@pytest.mark.long
def test_a_robot_of_the_suite_is_right(capsys):
    assert answer_of(capsys, "model", "check", "openarm_v1") == (
        0,
        {"success": True, "code": "OK", "message": "openarm_v1: nothing is wrong", "faults": []},
    )


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["new", "mine"], "expected one of --mjcf and --urdf"),
        (["new", "../mine", "--urdf", "r.urdf"], "names no robot"),
        (["new", "mine", "--urdf", "r.urdf", "--arm", "one=a"], "expected NAME=BASE_LINK:TIP_LINK"),
        (["check", "absent"], "no robot 'absent'; robots: "),
        (["semantics", "absent"], "no robot 'absent'; robots: "),
        (["sdf"], "sdf"),
    ],
)
def test_a_wrong_call_is_refused(robots, capsys, argv, words):
    code, answer = answer_of(capsys, "model", *argv)
    assert (code, answer["success"]) == (2, False)
    assert words in str(answer["message"])
    assert not list(robots.iterdir())
