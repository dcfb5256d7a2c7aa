# SPDX-License-Identifier: Apache-2.0
"""The description as text for other tools, and as a picture."""

from __future__ import annotations

import colorsys
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.resources import models_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import ROBOT
from openarm_common.scene.scene import PALETTE, load_scene
from openarm_sim_bridge.world.export import VIEWS, export, render, render_png
from tests.refusals import refused


@pytest.mark.requirement("A-12")
def test_mjcf_round_trip_keeps_joints_links_and_kinematics() -> None:
    description = RobotDescription.load()
    model = mujoco.MjModel.from_xml_string(export("mjcf"))
    data = mujoco.MjData(model)
    moving = {name: joint for name, joint in description.joints.items() if joint.type != "fixed"}
    assert {model.joint(i).name for i in range(model.njnt)} == set(moving)
    rng = np.random.default_rng(3)
    q = {name: rng.uniform(joint.lower, joint.upper) for name, joint in moving.items() if joint.mimic is None}
    for name, joint in moving.items():
        np.testing.assert_allclose(model.joint(name).range, (joint.lower, joint.upper), atol=5e-6)
        data.qpos[model.joint(name).qposadr[0]] = q[joint.mimic or name]
    mujoco.mj_kinematics(model, data)
    for name, T in description.link_poses(q).items():
        np.testing.assert_allclose(data.body(name).xpos, T[:3, 3], atol=5e-6, err_msg=name)


def test_mjcf_with_a_scene_holds_its_objects_and_cameras() -> None:
    model = mujoco.MjModel.from_xml_string(export("mjcf", scene="demo"))
    bodies = {model.body(i).name for i in range(model.nbody)}
    assert {"table", *(item.name for item in load_scene("demo").objects)} <= bodies
    assert model.ncam == 3


def test_urdf_and_srdf_are_those_of_the_description_without_paths_of_this_machine() -> None:
    description = RobotDescription.load()
    assert export("urdf") == description.urdf
    assert export("srdf") == description.srdf
    RobotDescription.from_urdf(export("urdf"), export("srdf"))
    for kind in ("urdf", "srdf", "mjcf"):
        assert str(Path(__file__).parents[2]) not in export(kind)  # type: ignore[arg-type]


@pytest.mark.requirement("A-12", "R-04")
@pytest.mark.parametrize("robot", ["openarm_v2", "panda"])
def test_files_of_a_robot_with_meshes_name_them_from_their_folder_and_are_read_again(
    robot: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also through a link: what is written has no path of the machine, and is a whole robot."""
    monkeypatch.setenv(ROBOT, robot)
    (tmp_path / "robots").symlink_to(models_dir() / "robots")
    description = RobotDescription.load()
    for kind in ("urdf", "mjcf"):
        text = export(kind, folder=models_dir())
        assert str(models_dir()) not in text
        assert f'"robots/{robot}/meshes/' in text
        (tmp_path / f"robot.{kind}").write_text(text)
    again = RobotDescription.from_files(tmp_path / "robot.urdf")
    assert again.joints.keys() == description.joints.keys()
    assert {name: len(link.meshes) for name, link in again.links.items()} == {
        name: len(link.meshes) for name, link in description.links.items()
    }
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "robot.mjcf")).nmesh > 10


def test_what_cannot_be_exported_is_refused() -> None:
    refused("unknown kind 'sdf'; kinds: urdf, mjcf, srdf", export, "sdf")  # type: ignore[arg-type]
    assert refused("mjcf only", export, "urdf", scene="demo").code is Code.INVALID_ARGUMENT
    refused("no scene 'moon'", export, "mjcf", scene="moon")
    refused(r"unknown view 'inside'; views: front.*cameras: overhead, wrist", render, view="inside")
    refused("no state 'dance'", render, posture="dance")


@pytest.mark.long
def test_a_picture_shows_every_object_in_its_colour_and_a_robot_without_colour(tmp_path: Path) -> None:
    path = tmp_path / "demo.png"
    render_png(path, width=640, height=480, view="overhead")
    image = cv2.imread(str(path))
    assert image.shape == (480, 640, 3)
    hsv = cv2.cvtColor(image, cv2.COLOR_BGR2HSV)
    vivid = (hsv[..., 1] > 130) & (hsv[..., 2] > 60)
    hues = {item.color: colorsys.rgb_to_hsv(*PALETTE[item.color][:3])[0] * 180 for item in load_scene("demo").objects}
    near = {name: np.abs((hsv[..., 0] - hue + 90) % 180 - 90) < 8 for name, hue in hues.items()}
    for name, mask in near.items():
        assert (mask & vivid).sum() > 300, name
    assert not (vivid & ~np.logical_or.reduce(list(near.values()))).any()  # nothing else has a hue
    empty = cv2.cvtColor(render("empty", width=320, height=240), cv2.COLOR_RGB2HSV)
    assert empty[..., 1].max() < 60


@pytest.mark.long
@pytest.mark.parametrize("view", VIEWS)
def test_every_view_shows_the_robot(view: str) -> None:
    image = render("empty", width=160, height=120, view=view)
    assert (image.max(axis=2) < 40).mean() > 0.005  # its black parts


def test_a_picture_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    refused("cannot write", render_png, tmp_path / "nowhere" / "a.png", width=64, height=64)
