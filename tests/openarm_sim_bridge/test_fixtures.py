# SPDX-License-Identifier: Apache-2.0
"""Fixtures of a scene: where they are, what carries them, what is wrong with one that can't be had."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.scene.scene import load_scene, parse_scene
from openarm_sim_bridge.world.model import compile_model
from tests.refusals import refused

MODEL = "<mujoco><worldbody>{}</worldbody></mujoco>"
BODY = '<body name="thing"><geom name="thing" size="0.01" contype="0" conaffinity="0" mass="0.1"/></body>'


@pytest.mark.parametrize(
    ("scene", "carrier"), [("calibration_wrist", ""), ("calibration_overhead", "openarm_right_link7")]
)
@pytest.mark.requirement("A-43")
def test_the_board_of_the_calibration_scenes_is_where_the_scene_says(scene: str, carrier: str) -> None:
    """Fixed on the table, or carried by the hand in whatever posture; nothing can touch it."""
    description = RobotDescription.load()
    world = load_scene(scene)
    model = compile_model(description, world, {})
    data = mujoco.MjData(model)
    joints = description.group_state("right_arm", "home")
    for name, q in joints.items():
        data.qpos[model.joint(name).qposadr[0]] = q
    mujoco.mj_kinematics(model, data)
    board = data.body("board_calibration_board")
    T = se3.make(board.xmat.reshape(3, 3), board.xpos)
    T_world_carrier = description.link_pose(carrier, joints) if carrier else np.eye(4)
    np.testing.assert_allclose(T, T_world_carrier @ world.fixtures[0].T_link_fixture, atol=1e-9)
    geom = model.geom("board_calibration_board")
    assert (geom.contype[0], geom.conaffinity[0]) == (0, 0)
    assert model.body("board_calibration_board").mass[0] == pytest.approx(0.1)


def fixed(path: Path, **keys: object) -> dict[str, object]:
    return {"fixtures": [{"name": "thing", "model": str(path), "position": [0.3, 0.0, 0.5], **keys}]}


@pytest.mark.parametrize(
    ("text", "keys", "words"),
    [
        (MODEL.format(BODY), {"link": "hand"}, "no link 'hand'; links: world"),
        (None, {}, "there is no file"),
        ("<mujoco", {}, "MuJoCo does not read"),
        (MODEL.format(""), {}, "has no body"),
    ],
)
def test_a_fixture_that_can_not_be_had_is_refused(tmp_path: Path, text: str | None, keys: dict, words: str) -> None:
    path = tmp_path / "thing.xml"
    if text is not None:
        path.write_text(text)
    scene = parse_scene(fixed(path, **keys), "scene")
    assert refused(words, compile_model, RobotDescription.load(), scene, {}).code is Code.CONFIG_INVALID


@pytest.mark.parametrize(
    ("keys", "words"), [({"y_axis": [0, 0, 2]}, "parallel or zero"), ({"model": ""}, "model"), ({"sise": 1}, "sise")]
)
def test_a_wrong_fixture_is_named(tmp_path: Path, keys: dict, words: str) -> None:
    assert refused(words, parse_scene, fixed(tmp_path / "thing.xml", **keys), "scene").code is Code.SCENE_INVALID
    twice = fixed(tmp_path / "thing.xml")["fixtures"] * 2  # type: ignore[operator]
    refused("'thing' is used twice", parse_scene, {"fixtures": twice}, "scene")
