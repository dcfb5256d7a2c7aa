# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate export`: each format, read again by what reads it, gives the mount that is stored."""

from __future__ import annotations

import shlex
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import yaml

from openarm_calibration.store.store import CalibrationStore, StoredCalibration
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, Intrinsics
from openarm_common.camera.lens_files import read_lens
from openarm_common.robot.description import RobotDescription
from tests.openarm_bringup.commands import calibrate, calibrate_fails

T = se3.make(se3.exp_so3((0.3, -1.1, 2.0)), (0.0412, -0.033, 0.0871))
K = Intrinsics(1280, 720, 911.5, 909.25, 640.2, 358.75)


@pytest.fixture
def store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CalibrationStore:
    monkeypatch.setenv("OPENARM_CALIBRATIONS", str(tmp_path / "store"))
    made = CalibrationStore(tmp_path / "store")
    made.save(StoredCalibration.of_mount("wrist", "openarm_right_link7", T, intrinsics=K))
    return made


def written(capsys, path: Path, *argv: str) -> str:
    code, _, err = calibrate(capsys, "export", *argv, "--out", str(path))
    assert code == 0, err
    return path.read_text()


@pytest.mark.requirement("P-28")
def test_easy_handeye2_places_the_optical_frame(capsys, store, tmp_path: Path) -> None:
    data = yaml.safe_load(written(capsys, tmp_path / "new" / "wrist.calib", "--format", "easy_handeye2"))
    parameters = data["parameters"]
    assert parameters["calibration_type"] == "eye_in_hand"
    assert parameters["robot_effector_frame"] == "openarm_right_link7"
    assert parameters["tracking_base_frame"] == "wrist_color_optical_frame"
    p, q = data["transform"]["translation"], data["transform"]["rotation"]
    read = se3.make(se3.matrix_from_quat_xyzw([q[n] for n in "xyzw"]), [p[n] for n in "xyz"])
    assert read == pytest.approx(T @ T_LINK_OPTICAL, abs=1e-9)


@pytest.mark.requirement("P-28")
def test_a_launch_file_with_the_line_publishes_the_mount(capsys, store) -> None:
    code, out, _ = calibrate(capsys, "export", "--format", "static_transform", "--camera", "wrist")
    assert code == 0
    node = ElementTree.fromstring(next(line for line in out.splitlines() if line.startswith("<node")))
    words = shlex.split(node.get("args"))
    given = dict(zip(words[::2], words[1::2], strict=True))
    q = [float(given[f"--q{n}"]) for n in "xyzw"]
    read = se3.make(se3.matrix_from_quat_xyzw(q), [float(given[f"--{n}"]) for n in "xyz"])
    assert (node.get("pkg"), node.get("exec")) == ("tf2_ros", "static_transform_publisher")
    assert (given["--frame-id"], given["--child-frame-id"]) == ("openarm_right_link7", "wrist_link")
    assert read == pytest.approx(T, abs=1e-8)


@pytest.mark.parametrize("frame", ["link", "optical"])
@pytest.mark.requirement("P-28")
def test_the_snippet_in_a_urdf_places_the_camera(capsys, store, tmp_path: Path, frame: str) -> None:
    snippet = written(capsys, tmp_path / "wrist.urdf", "--format", "urdf", "--frame", frame, "--child", "eye")
    robot = RobotDescription.from_urdf(f'<robot name="r"><link name="openarm_right_link7"/>{snippet}</robot>')
    wanted = T if frame == "link" else T @ T_LINK_OPTICAL
    assert robot.link_pose("eye", {}) == pytest.approx(wanted, abs=1e-8)


@pytest.mark.requirement("P-28")
def test_camera_info_has_all_fields_and_the_intrinsics(capsys, store, tmp_path: Path) -> None:
    text = written(capsys, tmp_path / "wrist.yaml", "--format", "camera_info")
    lens = read_lens(tmp_path / "wrist.yaml")
    assert lens.intrinsics == K
    assert lens.straight
    data = yaml.safe_load(text)
    assert list(data) == [
        "image_width", "image_height", "camera_name", "camera_matrix", "distortion_model", "distortion_coefficients",
        "rectification_matrix", "projection_matrix",
    ]  # fmt: skip
    P = np.array(data["projection_matrix"]["data"]).reshape(3, 4)
    assert P[:, :3] == pytest.approx(K.matrix)


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (["--format", "collada"], 2, "easy_handeye2"),
        (["--format", "urdf", "--camera", "overhead"], 1, "overhead"),
        (["--format", "urdf", "--store", "none"], 2, "0 calibrations in none: none"),
        (["--format", "urdf", "--out", "/proc/nowhere/a.urdf"], 1, "can't write"),
        (["--format", "urdf", "--camera", "../wrist"], 2, "expected lower-case letters"),
    ],
)
def test_wrong_calls(capsys, store, tmp_path, monkeypatch, argv: list[str], code: int, words: str) -> None:
    monkeypatch.chdir(tmp_path)
    calibrate_fails(capsys, code, words, "export", *argv)


def test_a_calibration_of_pose_pairs_has_no_camera_info(capsys, store) -> None:
    store.save(StoredCalibration.of_mount("side", "base", T))
    assert calibrate(capsys, "export", "--format", "camera_info", "--camera", "side")[0] == 2
    calibrate_fails(capsys, 2, "2 calibrations", "export", "--format", "urdf")
