# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate import` on files of other tools' own writing, solved by one command, and on hostile ones."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from openarm_bringup import cli
from openarm_calibration.board.board import read_board
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.sampling.samples import load_session
from openarm_calibration.store.store import CalibrationStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.robot.description import RobotDescription
from tests.openarm_bringup.commands import answer_of, calibrate_fails
from tests.openarm_calibration import foreign_files as files

pytestmark = [pytest.mark.requirement("R-14"), pytest.mark.usefixtures("own_store")]

BOARD = "charuco:7x5:34mm:26mm:DICT_6X6_250"
RATIONAL = np.array([0.2, -0.1, 0.001, -0.0005, 0.02, 0.35, -0.05, 0.01])
PLUMB_BOB = np.array([-0.25, 0.06, 0.001, 0.0005, 0.0])


def off(data: dict, known: files.Truth) -> tuple[float, float]:
    item = data["calibration"]
    link = se3.make(se3.matrix_from_quat_xyzw(item["quaternion_xyzw"]), item["position"])
    return mount_error(link @ T_LINK_OPTICAL, known.X)


@pytest.mark.parametrize(
    ("writer", "name", "kind"),
    [
        (files.easy_handeye2, "demo.samples", "eye_in_hand"),
        (files.moveit_yaml, "samples.yaml", "eye_to_hand"),
        (files.moveit_json, "samples.json", "eye_in_hand"),
    ],
    ids=["easy_handeye2", "moveit_yaml", "moveit_json"],
)
@pytest.mark.requirement("P-28", "A-36")
def test_pose_pairs_of_other_tools_are_solved_and_stored_by_one_command(
    capsys, tmp_path: Path, writer, name: str, kind: str
) -> None:
    known = files.truth("in_hand" if kind == "eye_in_hand" else "to_hand", 15, 2e-4, 4e-4)
    path = writer(tmp_path / name, known)
    options = ("--camera-kind", kind, "--camera", "cam", "--save")
    code, data = answer_of(capsys, "calibrate", "import", str(path), *options)
    assert code == 0, data["message"]
    assert off(data, known)[0] < 1e-3
    assert off(data, known)[0] < 4.0 * data["figures"]["sigma_translation"]
    assert set(data["left_out"]) >= {"REFINED", "TSAI", "PARK", "SHAH"}
    stored = CalibrationStore(tmp_path / "store").load("cam")
    assert stored.parent == ("tip" if kind == "eye_in_hand" else "base")
    assert stored.intrinsics is None


@pytest.mark.long
def test_the_kind_that_a_file_of_easy_handeye2_states_is_used_and_a_missing_one_asked_for(capsys, tmp_path) -> None:
    known = files.truth("to_hand")
    path = files.easy_handeye2(tmp_path / "a.samples", known, "eye_on_base")
    code, data = answer_of(capsys, "calibrate", "import", str(path))
    assert code == 0
    assert off(data, known)[0] < 1e-5
    path = files.easy_handeye2(tmp_path / "b.samples", known)
    calibrate_fails(capsys, 2, "give --camera-kind eye_in_hand or eye_to_hand", "import", str(path))


def info(path: Path, coefficients: np.ndarray | None = None) -> str:
    d = [] if coefficients is None else coefficients.tolist()
    model = "rational_polynomial" if len(d) == 8 else "plumb_bob"
    k = files.K
    path.write_text(f"fx: {k.fx}\nfy: {k.fy}\ncx: {k.cx}\ncy: {k.cy}\nwidth: {k.width}\nheight: {k.height}\n"
                    f"distortion_model: {model}\nd: {d}\n")  # fmt: skip
    return str(path)


@pytest.mark.long
@pytest.mark.parametrize(
    ("setup", "rotation", "unit", "frames", "lens"),
    [
        ("in_hand", "wxyz", "mm", "T_base_tip", None),
        ("to_hand", "xyz_deg", "m", "T_tip_base", PLUMB_BOB),
        ("in_hand", "rotvec", "m", "T_base_tip", RATIONAL),
    ],
)
@pytest.mark.requirement("P-28", "A-36", "A-42")
def test_a_csv_and_a_folder_of_images_are_solved_with_the_convention_found(
    capsys, tmp_path: Path, setup, rotation, unit, frames, lens
) -> None:
    """Also through a lens; the session that is written is solved again by `calibrate solve` without the robot."""
    known = files.truth(setup, 7)
    names = files.pictures(tmp_path / "images", known, read_board(BOARD), lens)
    rows = files.numbers(known.A, rotation, unit, frames)
    path = files.table(tmp_path / "poses.csv", rows, names if lens is None else None, "image, x, y, z, a, b, c")
    session = tmp_path / "cam.npz"
    argv = (
        "--camera-kind", f"eye_{setup}", "--frames", frames, "--images", str(tmp_path / "images"), "--board", BOARD,
        "--intrinsics", info(tmp_path / "cam.yaml", lens), "--session", str(session),
    )  # fmt: skip
    code, data = answer_of(capsys, "calibrate", "import", str(path), *argv)
    assert code == 0, data["message"]
    assert off(data, known)[0] < 2e-4
    assert data["conventions"][0]["robot"].startswith(f"{frames}, ")
    assert data["conventions"][0]["robot"].endswith(f", {unit}")
    assert all(row["sample"] for row in data["images"])
    samples, _ = load_session(session, RobotDescription.load())
    assert samples.pose(samples.samples[3].joints) == pytest.approx(known.A[3], abs=1e-6)
    assert cli.run(["calibrate", "solve", str(session)]) == 0
    assert "camera on" in capsys.readouterr().out


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with good files, and bad ones."""
    folder = tmp_path_factory.mktemp("foreign")
    known = files.truth("in_hand", 6)
    files.pictures(folder / "images", known, read_board("circles"))
    files.table(folder / "poses.csv", files.numbers(known.A, "xyzw"))
    files.table(folder / "short.csv", files.numbers(known.A, "xyzw")[:, :5])
    files.table(folder / "named.csv", files.numbers(known.A, "xyzw"), [f"img{k}.png" for k in range(6)])
    (folder / "ragged.csv").write_text("1,2,3,0,0,0,1\n1,2,3\n")
    (folder / "empty.csv").write_text("")
    (folder / "binary.csv").write_bytes(b"\x00\xff\xfe" * 100)
    (folder / "words.samples").write_text("samples: hello")
    (folder / "one.samples").write_text("samples:\n- robot: {translation: {x: 0, y: 0, z: 0}}\n")
    files.moveit_json(folder / "pairs.json", known)
    bent = [
        {"effector_wrt_world": A.tolist(), "object_wrt_sensor": C.tolist()}
        for A, C in zip(known.A, known.C, strict=True)
    ]
    bent[1]["effector_wrt_world"] = np.full((4, 4), 2.0).tolist()
    (folder / "bent.yaml").write_text(json.dumps(bent))
    (folder / "deep.json").write_text("[" * 5000)
    (folder / "alias.yaml").write_text("a: &a [1]\nb: *a\n")
    (folder / "many.json").write_text(json.dumps([[np.eye(4).tolist()] * 2] * 2001))
    (folder / "tool.txt").write_text("hello\n")
    (folder / "mapping.yaml").write_text("a: 1\n")
    (folder / "info.yaml").write_text("image_width: 640\n")
    (folder / "few").mkdir()
    (folder / "broken").mkdir()
    for k in range(6):
        (folder / "broken" / f"{k}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(40))
    return folder


IMAGES = ("--images", "images", "--board", "circles", "--intrinsics", "640,480,415.7,415.7,319.5,239.5")
HAND = ("--camera-kind", "eye_in_hand")


@pytest.mark.parametrize(
    ("argv", "code", "words"),
    [
        (("nowhere.csv",), 2, "there is no nowhere.csv"),
        (("poses.csv",), 2, "has poses of the robot alone ('poses', 6); give --images FOLDER"),
        (("poses.csv", *IMAGES), 2, "give --camera-kind eye_in_hand or eye_to_hand"),
        (("poses.csv", *HAND, "--images", "images"), 2, "need --board"),
        (
            ("poses.csv", *HAND, *IMAGES[:2], *IMAGES[4:], "--board", "charuco:7x5:9"),
            2,
            "expected such as circles:4x11",
        ),
        (("poses.csv", *HAND, *IMAGES[:4], "--intrinsics", "1,2,3"), 2, "WIDTH,HEIGHT,FX,FY,CX,CY"),
        (("poses.csv", *HAND, *IMAGES[:4], "--intrinsics", "640,480,0,415,319,239"), 1, "fx=0"),
        (("poses.csv", *HAND, *IMAGES[:4], "--intrinsics", "info.yaml"), 1, "has no intrinsics of a camera"),
        (
            ("poses.csv", *HAND, *IMAGES[:4], "--intrinsics", "1280,720,900,900,640,360"),
            1,
            "but its intrinsics (camera_info) are of 1280x720",
        ),
        (("poses.csv", *HAND, *IMAGES[2:], "--images", "few"), 2, "has 0 images for 6 poses"),
        (("poses.csv", *HAND, *IMAGES[2:], "--images", "broken"), 1, "is no image that can be read"),
        (("poses.csv", *HAND, *IMAGES[:2], *IMAGES[4:], "--board", "charuco"), 1, "in 0 of 6 images"),
        (("poses.csv", *HAND, *IMAGES, "--rotation", "matrix"), 1, "give --rotation xyzw"),
        (("poses.csv", *HAND, *IMAGES, "--image-topic", "/a"), 2, "--image-topic is no option for poses and images"),
        (("short.csv", *HAND, *IMAGES), 1, "5 numbers a pose"),
        (("named.csv", *HAND, *IMAGES), 2, "has no image 'img0.png'"),
        (("ragged.csv", *HAND, *IMAGES), 1, "ragged.csv:2 has 3 cells, expected 7"),
        (("empty.csv", *HAND, *IMAGES), 1, "has no poses"),
        (("binary.csv", *HAND, *IMAGES), 1, "is no text in UTF-8"),
        (("tool.txt", *HAND, *IMAGES), 1, "has no poses"),
        (("words.samples", *HAND), 1, "has no poses that are repeated"),
        (("one.samples", *HAND), 1, "has no poses that are repeated"),
        (("bent.yaml", *HAND), 1, "record 2 is no rotation as matrix by rows"),
        (("pairs.json",), 2, "give --camera-kind"),
        (("pairs.json", *HAND, "--session", "a.npz"), 2, "--session is no option for pairs of poses"),
        (("pairs.json", *HAND, "--fix", "up"), 2, "expected an axis and metres, such as z=0.12"),
        (("deep.json", *HAND), 1, "is not valid JSON"),
        (("alias.yaml", *HAND), 1, "aliases are not accepted"),
        (("many.json", *HAND), 1, "has 2001 poses, expected at most 2000"),
        (("mapping.yaml", *HAND), 1, "has no poses that are repeated"),
        (("few", *HAND), 1, "has no file of poses; read are .yaml"),
    ],
)
@pytest.mark.requirement("A-45")
def test_wrong_calls_and_hostile_files_end_in_a_sentence(capsys, made: Path, monkeypatch, argv, code, words) -> None:
    monkeypatch.chdir(made)
    before = sorted(made.iterdir())
    calibrate_fails(capsys, code, words, "import", *argv)
    assert sorted(made.iterdir()) == before
