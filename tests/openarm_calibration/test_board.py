# SPDX-License-Identifier: Apache-2.0
"""Boards, their files, and finding them in images, also in MuJoCo's."""

from __future__ import annotations

import re
import struct
import zlib
from pathlib import Path

import cv2
import mujoco
import numpy as np
import pytest

from openarm_calibration.board.board import Board, Charuco, CircleGrid, parse_board
from openarm_calibration.board.board_files import pdf, png, write_board
from openarm_calibration.board.detect import detect, guess_pose
from openarm_calibration.board.detect_circles import refined
from openarm_calibration.handeye.problem import project
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import models_dir
from tests.openarm_calibration import known_session

K = Intrinsics.from_fovy(640, 480, 60.0)
ROW = np.array([K.fx, K.fy, K.cx, K.cy])
BOARDS = (CircleGrid(), Charuco())


def pose(rng: np.random.Generator, far: float = 0.7) -> np.ndarray:
    tilt = se3.exp_so3((*rng.normal(0.0, 0.35, 2), 0.0))
    return se3.make(tilt @ se3.rot_z(rng.uniform(-3.1, 3.1)), (*rng.uniform(-0.04, 0.04, 2), rng.uniform(0.3, far)))


def photograph(board: Board, T: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Picture of a board with grey noise of 2."""
    image = known_session.photograph(board, T, K) + rng.normal(0.0, 2.0, (480, 640))
    return np.clip(image, 0, 255).astype(np.uint8)


@pytest.mark.long
@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
@pytest.mark.requirement("A-42")
def test_boards_are_found_in_at_least_95_percent_of_views_and_never_in_a_wrong_order(board: Board) -> None:
    """Any turn in the image, tilts to 40°: every mark is within a pixel of its own place."""
    rng = np.random.default_rng(1)
    found = seen = 0
    while seen < 8:
        T = pose(rng)
        true = project(board.points, board.radius, T, ROW)
        if not ((true > 10) & (true < (629, 469))).all():
            continue
        seen += 1
        try:
            detection = detect(board, photograph(board, T, rng))
        except OpenArmError:
            continue
        found += 1
        away = np.linalg.norm(detection.pixels - true[detection.ids], axis=1)
        assert away.max() < (0.1 if board.kind == "circles" else 1.0)
        T_found, _ = guess_pose(board.points[detection.ids], detection.pixels, board.radius, K)
        assert np.linalg.norm(T_found[:3, 3] - T[:3, 3]) < 2e-3
    assert found >= 0.95 * seen


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
def test_an_image_without_the_board_says_what_was_seen(board: Board) -> None:
    with pytest.raises(OpenArmError, match=r"expected; is all of the board|are needed; is the board") as caught:
        detect(board, np.full((480, 640), 128, np.uint8))
    assert caught.value.code == Code.NOTHING_DETECTED
    with pytest.raises(OpenArmError, match="grey 8-bit"):
        detect(board, np.zeros((4, 4, 3), np.uint8))


@pytest.mark.long
@pytest.mark.requirement("A-43")
def test_the_board_in_mujoco_is_found_to_a_hundredth_of_a_pixel(tmp_path: Path) -> None:
    """Its MJCF, rendered as the suite's cameras are; no shift and no stretch, so pixels and texture are where we think.

    Errors that the marks of a view share do not average out: a stretch of 0.06 % puts a camera 0.4 mm off.
    """
    board = CircleGrid()
    write_board(board, tmp_path / "board.xml")
    spec = mujoco.MjSpec.from_file(str(tmp_path / "board.xml"))
    spec.worldbody.add_camera(name="c", fovy=60.0)
    spec.visual.headlight.ambient = (0.6, 0.6, 0.6)
    spec.visual.quality.offsamples = 0
    spec.visual.map.znear, spec.stat.extent = 0.02, 1.0
    model = spec.compile()
    data = mujoco.MjData(model)
    rng = np.random.default_rng(3)
    errors, stretch = [], []
    with mujoco.Renderer(model, 480, 640) as renderer:
        while len(errors) < 4:
            T = pose(rng)
            true = project(board.points, board.radius, T, ROW)
            if not ((true > 10) & (true < (629, 469))).all():
                continue
            placed = se3.make(se3.rot_x(np.pi)) @ T
            model.body("calibration_board").pos[:] = placed[:3, 3]
            model.body("calibration_board").quat[:] = np.roll(se3.quat_xyzw_from_matrix(placed[:3, :3]), 1)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, "c")
            errors.append(detect(board, cv2.cvtColor(renderer.render(), cv2.COLOR_RGB2GRAY)).pixels - true)
            arms = true - true.mean(axis=0)
            stretch.append(np.sum(errors[-1] * arms) / np.sum(arms**2))
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.abs(np.mean(np.concatenate(errors), axis=0)).max() < 0.002
    assert abs(np.mean(stretch)) < 3e-5


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.kind)
@pytest.mark.requirement("A-43")
def test_a_picture_of_any_shape_is_exactly_the_plate(board: Board) -> None:
    """Marks of the stretched picture, found as corners or centroids, are where the board says."""
    columns, rows = 1024, 1500
    image = board.picture(columns, rows)
    scale = np.array([columns, rows]) / board.size
    wanted = (board.points[:, :2] + np.array(board.size) / 2.0) * scale - 0.5
    if board.kind == "charuco":
        found = cv2.cornerSubPix(
            image, wanted.astype(np.float32).reshape(-1, 1, 2).copy(), (8, 8), (-1, -1), (3, 50, 1e-4)
        ).reshape(-1, 2)
        assert np.abs((found - wanted).mean(axis=0)).max() < 0.02
        assert np.abs(found - wanted).max() < 0.4
        return
    H = np.array([[scale[0], 0.0, 0.0], [0.0, scale[1], 0.0], [0.0, 0.0, 1.0]])
    H[:2, 2] = scale * board.size / 2.0 - 0.5
    found, sure = refined(image, wanted + np.array([0.7, -0.5]), board.points[:, :2], board.radius, H)
    assert sure.all()
    assert np.abs(found - wanted).max() < 0.01


def test_png_and_pdf_are_true_to_scale(tmp_path: Path) -> None:
    """The PNG carries its resolution and has as many pixels as its size asks for; the PDF page holds the board."""
    board = Charuco()
    data = png(board, 150)
    at = data.index(b"pHYs") + 4
    per_metre, _, unit = struct.unpack(">IIB", data[at : at + 9])
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
    assert unit == 1
    assert image.shape[1] / per_metre == pytest.approx(board.size[0], abs=2e-4)
    write_board(board, tmp_path / "board.pdf")
    page = (tmp_path / "board.pdf").read_bytes()
    assert page.startswith(b"%PDF-1.4")
    assert page.rstrip().endswith(b"%%EOF")
    assert b"/Subtype /Image" not in page
    box = page[page.index(b"/MediaBox [") + 11 :].split(b"]")[0].split()
    assert float(box[2]) / 72 * 0.0254 >= board.size[0]
    assert float(box[3]) / 72 * 0.0254 >= board.size[1] + 0.022


@pytest.mark.requirement("A-43")
def test_marks_in_the_pdf_are_at_their_places(tmp_path: Path) -> None:
    """The outlines of the page's paths: circles around the board's points, black squares from edge to edge."""
    circles, charuco = CircleGrid(), Charuco()
    outlines = [shape for shape in pdf_outlines(circles) if len(shape) > 8]
    middles = np.array([(shape.min(axis=0) + shape.max(axis=0)) / 2.0 for shape in outlines])
    wanted = circles.points[:, :2] * (1.0, -1.0)
    middles -= middles.mean(axis=0) - wanted.mean(axis=0)
    assert np.abs(middles[np.lexsort(middles.T.round(6))] - wanted[np.lexsort(wanted.T.round(6))]).max() < 1e-6
    assert np.array([np.ptp(shape, axis=0) for shape in outlines]) == pytest.approx(circles.diameter, abs=1e-6)

    boxes = [shape for shape in pdf_outlines(charuco) if len(shape) == 4][:-3]  # without the bar
    pattern = np.array([charuco.columns, charuco.rows]) * charuco.spacing
    assert np.ptp(np.concatenate(boxes), axis=0) == pytest.approx(pattern, abs=1e-6)
    scale = 8000.0
    drawn = np.full((round(pattern[1] * scale), round(pattern[0] * scale)), 255, np.uint8)
    low, high = np.concatenate(boxes).min(axis=0), np.concatenate(boxes).max(axis=0)
    for box in boxes:
        (left, bottom), (right, top) = box.min(axis=0) - low, box.max(axis=0) - low
        rows = [round(((high - low)[1] - y) * scale) for y in (top, bottom)]
        drawn[rows[0] : rows[1], round(left * scale) : round(right * scale)] = 0
    whole = np.pad(drawn, round(charuco.border * scale), constant_values=255)
    away = whole.astype(int) - charuco.draw(scale)
    assert np.mean(np.abs(away) > 128) < 0.005  # but for edges of a pixel


def pdf_outlines(board: Board) -> list[np.ndarray]:
    """Points (n, 2) in metres of each closed path of the board's PDF; y up."""
    stream = re.search(rb"stream\r?\n(.*?)\r?\nendstream", pdf(board), re.DOTALL)
    assert stream is not None
    outlines = []
    for path in re.split(r"\nh\n", zlib.decompress(stream.group(1)).decode())[:-1]:
        ends = [line.split()[-3:-1] for line in path.splitlines() if line.endswith((" m", " l", " c"))]
        outlines.append(np.array(ends, np.float64) / 72.0 * 0.0254)
    return outlines[1:]  # after the white of the page


@pytest.mark.requirement("A-43")
def test_the_board_of_the_scenes_is_the_one_that_the_suite_writes(tmp_path: Path) -> None:
    write_board(CircleGrid(), tmp_path / "circles_4x11.xml")
    kept = models_dir() / "boards"
    assert (kept / "circles_4x11.xml").read_text() == (tmp_path / "circles_4x11.xml").read_text()
    was, now = (cv2.imread(str(folder / "circles_4x11.png"), cv2.IMREAD_UNCHANGED) for folder in (kept, tmp_path))
    assert was.shape == (2048, 2048)
    assert np.array_equal(was, now)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        ({"rows": 10}, "is the same after half a turn"),
        ({"diameter": 0.03}, "touch"),
        ({"border": 0.001}, "cuts the outer circles"),
        ({"size": 3}, "unknown key"),
        ({"kind": "charuco", "diameter": 0.034}, "expected 0.4 to 0.9"),
        ({"spacing": float("nan")}, "spacing"),
    ],
)
def test_boards_that_cant_work_are_refused(data: dict[str, object], words: str) -> None:
    with pytest.raises(OpenArmError, match=words):
        parse_board(data)
