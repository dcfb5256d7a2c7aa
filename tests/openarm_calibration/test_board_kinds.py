# SPDX-License-Identifier: Apache-2.0
"""All kinds of boards in pictures with known marks: warped, noisy, blurred, distorted, in part, and of other boards."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_calibration.board.board import SPELLINGS, Board, read_board
from openarm_calibration.board.circles import CircleGrid, SymmetricCircles
from openarm_calibration.board.detect import detect
from openarm_calibration.board.detection import consistent, smooth_image
from openarm_calibration.board.squares import Charuco
from openarm_calibration.handeye.problem import project
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from tests.openarm_calibration import foreign_files as files
from tests.openarm_calibration import known_session
from tests.refusals import refuses

K = Intrinsics.from_fovy(640, 480, 60.0)
ROW = np.array([K.fx, K.fy, K.cx, K.cy])
BOARDS = [
    read_board(text)
    for text in (
        "symmetric_circles:7x6:24mm:12mm", "chessboard:8x5:25mm", "chessboard:8x6:22mm",
        "charuco:7x5:34mm:26mm:DICT_6X6_250", "charuco:7x6:30mm:22mm:DICT_4X4_50:legacy", "aprilgrid:5x4:30mm:0.3",
        "marker:80mm:DICT_APRILTAG_36h11:id=7", "marker:80mm:DICT_6X6_250:id=9",
    )
]  # fmt: skip
LENS = np.array([-0.42, 0.15, 0.002, -0.001, 0.0])


def pose(rng: np.random.Generator, board: Board) -> Array:
    turn = rng.uniform(-0.6, 0.6) if board.ambiguity else rng.uniform(-3.1, 3.1)
    tilt = se3.exp_so3((*rng.normal(0.0, 0.3, 2), 0.0))
    return se3.make(tilt @ se3.rot_z(turn), (*rng.uniform(-0.03, 0.03, 2), rng.uniform(0.35, 0.55)))


def seen(board: Board, T: Array, seed: int = 0, noise: float = 2.0, blur: float = 0.0, lens: Array | None = None):
    """Return a picture of a board, and where its marks are in it."""
    true = project(board.points, board.radius, T, ROW)
    image = known_session.photograph(board, T, K)
    if lens is not None:
        image = files.distorted(image, lens)
        rays = np.column_stack([(true - ROW[2:]) / ROW[:2], np.ones(len(true))])
        true = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K.matrix, lens)[0].reshape(-1, 2)
    if blur:
        image = cv2.GaussianBlur(image, (0, 0), blur)
    image = image + np.random.default_rng(seed).normal(0.0, noise, image.shape)
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), true


def errors(board: Board, image: np.ndarray, true: Array) -> Array:
    detection = detect(board, image)
    return detection.pixels - true[detection.ids]


@pytest.mark.parametrize("board", BOARDS, ids=lambda b: b.label[:24])
@pytest.mark.requirement("A-42", "A-43")
def test_marks_are_found_to_a_few_hundredths_of_a_pixel(board: Board) -> None:
    """Any turn that the board's rule allows, tilts to 35 degrees, grey noise of 2."""
    rng = np.random.default_rng(4)
    away = []
    while len(away) < 2:
        image, true = seen(board, pose(rng, board), len(away))
        if ((true > 12) & (true < (627, 467))).all():
            away.append(errors(board, image, true))
    assert np.sqrt(np.mean(np.concatenate(away) ** 2)) < 0.02
    assert np.abs(np.concatenate(away)).max() < 0.2


@pytest.mark.parametrize("board", BOARDS[:6], ids=lambda b: b.label[:24])
@pytest.mark.requirement("A-42")
def test_a_lens_that_distorts_by_many_pixels_does_not_refuse_its_board(board: Board) -> None:
    """Marks are a pixel and more off the image of any plane, and found where the lens shows them."""
    T = se3.make(se3.rot_x(0.3) @ se3.rot_y(0.2), (0.01, 0.0, 0.34))
    image, true = seen(board, T, lens=LENS)
    detection = detect(board, image)
    assert detection.residual > 0.45
    assert len(detection.ids) >= 0.9 * len(true)
    assert np.sqrt(np.mean((detection.pixels - true[detection.ids]) ** 2)) < 0.08


@pytest.mark.parametrize("blur", [1.0, pytest.param(2.0, marks=pytest.mark.long), 3.5])
@pytest.mark.parametrize("board", [BOARDS[k] for k in (0, 1, 3, 5, 6)], ids=lambda b: b.label[:24])
@pytest.mark.requirement("A-42")
def test_blurred_and_noisy_pictures_are_read_rightly_or_refused(board: Board, blur: float) -> None:
    """Never a mark that is a tenth of its pitch off; at a blur of one pixel all boards are found."""
    T = se3.make(se3.rot_x(0.35) @ se3.rot_z(0.3), (0.0, 0.01, 0.42))
    image, true = seen(board, T, noise=8.0, blur=blur)
    try:
        away = errors(board, image, true)
    except OpenArmError as error:
        if error.code != Code.NOTHING_DETECTED or blur <= 1.0:
            raise
        return
    assert np.sqrt(np.mean(away**2)) < 0.15 * blur
    assert np.abs(away).max() < 1.0


@pytest.mark.parametrize("board", [BOARDS[3], BOARDS[4], BOARDS[5]], ids=lambda b: b.label[:24])
@pytest.mark.requirement("A-42")
def test_boards_with_ids_are_read_in_part(board: Board) -> None:
    T = se3.make(se3.rot_x(0.2), (0.21, 0.04, 0.36))
    image, true = seen(board, T)
    detection = detect(board, image)
    inside = ((true > 0) & (true < (639, 479))).all(axis=1)
    assert 8 <= len(detection.ids) <= inside.sum() < len(true)
    assert np.linalg.norm(detection.pixels - true[detection.ids], axis=1).max() < 0.2


@pytest.mark.requirement("A-42")
def test_a_chessboard_of_odd_and_even_counts_is_read_in_any_turn_and_others_upright() -> None:
    """Half a turn of 8x5 is seen by its colours; 8x6 is read as if it stood upright, and its label says so."""
    down = se3.make(se3.rot_z(np.pi - 0.2), (0.0, 0.0, 0.4))
    told, ruled = BOARDS[1], BOARDS[2]
    image, true = seen(told, down)
    assert np.abs(errors(told, image, true)).max() < 0.2
    image, true = seen(ruled, down)
    assert np.abs(detect(ruled, image).pixels - true[::-1]).max() < 0.2
    assert "read upright" in ruled.label
    assert not told.ambiguity


@pytest.mark.parametrize(
    ("shown", "wanted"),
    [(1, 2), (2, 1), (3, 4), (4, 3), (0, 2), (6, 7), (5, 6), (3, 5), (1, 0)],
)
@pytest.mark.requirement("A-42")
def test_another_board_is_refused_in_a_sentence(shown: int, wanted: int) -> None:
    image, _ = seen(BOARDS[shown], se3.make(se3.rot_x(0.2), (0.0, 0.0, 0.4)))
    with refuses(Code.NOTHING_DETECTED, r"no |tags|corners|markers"):
        detect(BOARDS[wanted], image)


@pytest.mark.parametrize("board", [b for b in BOARDS if b.kind in ("charuco", "aprilgrid", "marker")],
                         ids=lambda b: b.label[:24])  # fmt: skip
def test_a_mirrored_picture_of_a_board_with_ids_is_refused(board: Board) -> None:
    """The mirror image of a circle grid is the grid itself after half a turn."""
    image, _ = seen(board, se3.make(se3.rot_x(0.2), (0.0, 0.0, 0.4)))
    with refuses(Code.NOTHING_DETECTED):
        detect(board, np.ascontiguousarray(image[:, ::-1]))


def test_a_corner_that_contradicts_the_others_is_left_out() -> None:
    """A cable over one corner of a ChArUco board: the rest is used."""
    board = BOARDS[3]
    image, true = seen(board, se3.make(None, (0.0, 0.0, 0.4)))
    u, v = np.round(true[9]).astype(int)
    image[v - 4 : v + 3, u - 3 : u + 9] = 30
    detection = detect(board, image)
    assert np.abs(detection.pixels - true[detection.ids]).max() < 0.3
    assert len(detection.ids) >= len(true) - 5


def test_marks_of_a_smooth_image_are_kept_and_one_that_is_off_is_not() -> None:
    board = BOARDS[1]
    plane = board.points[:, :2]
    rays = np.column_stack([plane / 0.3, np.ones(len(plane))])
    pixels = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K.matrix, LENS)[0].reshape(-1, 2)
    assert smooth_image(plane, pixels)[1] < 0.05
    pixels[11] += (3.0, -2.0)
    good, deviation = consistent(plane, pixels, 0.3)
    assert list(np.flatnonzero(~good)) == [11]
    assert deviation < 0.05


@pytest.mark.parametrize("rows", [4, 5])
@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_boards_are_drawn_as_opencv_does(rows: int, legacy: bool) -> None:
    board = Charuco(columns=6, rows=rows, spacing=0.04, diameter=0.03, border=0.0, legacy=legacy)
    theirs = board.board.generateImage((6 * 140, rows * 140), marginSize=0)
    assert np.mean(np.abs(theirs.astype(int) - board.picture(6 * 140, rows * 140)) > 100) < 0.03


def test_an_aprilgrid_has_tag_0_at_the_lower_left_and_upright_as_kalibr_prints_it() -> None:
    """The first code of the family 36h11, row by row from its highest bit, within two modules of black."""
    board = read_board("aprilgrid:2x3:40mm:0.25")
    grey = board.model_copy(update={"border": 0.0}).picture(1100, 1600)
    scale = 1100 / board.pattern[0]
    left, top = (board.corners[0] + np.array(board.pattern) / 2.0) * scale
    module = 0.04 / 10 * scale
    bits = [
        [grey[int(top + (i + 0.5) * module), int(left + (j + 0.5) * module)] > 128 for j in range(10)]
        for i in range(10)
    ]
    code = [[bool(0xD5D628584 >> (35 - 6 * i - j) & 1) for j in range(6)] for i in range(6)]
    inner = np.array(bits)[2:8, 2:8]
    assert inner.tolist() == code
    assert np.count_nonzero(bits) == np.count_nonzero(inner)
    assert board.corners[0][0] < 0 < board.corners[0][1]


@given(st.integers(3, 9), st.integers(3, 9), st.integers(12, 60), st.sampled_from(["4X4_250", "DICT_6X6_250"]))
def test_spelled_boards_are_those_of_their_keys(columns: int, rows: int, mm: int, codes: str) -> None:
    spelled = read_board(f"charuco:{columns}x{rows}:{mm}mm:{mm * 0.07:g}cm:{codes}")
    keys = f"{{kind: charuco, columns: {columns}, rows: {rows}, spacing: {mm / 1e3}, diameter: {mm * 0.7 / 1e3:.9g},"
    assert spelled == read_board(f"{keys} dictionary: {codes}}}")


def test_the_spellings_in_errors_are_those_of_the_defaults() -> None:
    for text in SPELLINGS:
        board = read_board(text.split("[")[0])
        assert board == type(board)()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("charuco:7x5:34mm:26mm:DICT_9X9", "dictionaries: DICT_4X4_100"),
        ("charuco:7x5:34mm:26mm:27mm", "is no size of a charuco board"),
        ("hexagons:7x5", "boards: circles, symmetric_circles, chessboard, charuco, aprilgrid, marker"),
        ("marker:id=9999", "has ids 0 to 586"),
        ("aprilgrid:24x24:20mm:2", "is no size of a aprilgrid"),
        ("charuco:40x40:34mm:26mm:DICT_4X4_50", "the 50 markers of DICT_4X4_50"),
        ("{target_type: circlegrid}", "expected aprilgrid or checkerboard"),
        ("{target_type: checkerboard, targetCols: 6, targetRows: 7, rowSpacingMeters: 0.1, colSpacingMeters: 0.06}",
         "equal edges"),
        ("nowhere.yaml", "does not exist"),
    ],
)  # fmt: skip
def test_boards_that_are_none_are_refused_with_what_is_valid(text: str, words: str) -> None:
    with pytest.raises(OpenArmError, match=words):
        read_board(text)


def test_target_files_of_kalibr_are_read() -> None:
    text = "{target_type: aprilgrid, tagCols: 5, tagRows: 4, tagSize: 0.03, tagSpacing: 0.3}"
    assert read_board(text) == read_board("aprilgrid:5x4:30mm:0.3")


@pytest.mark.parametrize(
    "board",
    [read_board("chessboard:4x3:50mm"), *(BOARDS[k] for k in (0, 3, 5, 6)), read_board("circles:4x11:20mm:15mm")],
    ids=lambda b: b.kind,
)
@pytest.mark.requirement("A-42")
@pytest.mark.requirement("M-04")
def test_a_far_board_of_which_the_paper_ends_close_by_is_found_in_a_large_picture(board: Board) -> None:
    """Of 15 to 60 px a square, without softened edges, before something dark; always the same answer."""
    optics, rng = Intrinsics(1920, 1080, 1371.0, 1371.0, 959.5, 539.5), np.random.default_rng(3)
    if isinstance(board, CircleGrid | SymmetricCircles):
        end = np.abs(board.points[:, :2]).max(axis=0) + 0.7 * board.diameter
    else:
        end = np.array(board.pattern) / 2.0 + 0.2 * board.feature
    for k in range(4):
        turn = se3.exp_so3((*rng.uniform(-0.45, 0.45, 2), 0.0)) @ se3.rot_z(rng.uniform(-0.7, 0.7))
        T = se3.make(turn, (rng.uniform(-0.3, 0.3), rng.uniform(-0.2, 0.2), 0.8 + 0.35 * k))
        image = known_session.photograph(board, T, optics, end)
        true = project(board.points, board.radius, T, np.array([1371.0, 1371.0, 959.5, 539.5]))
        detection = detect(board, image)
        away = detection.pixels - true[detection.ids]
        assert len(detection.ids) >= 0.9 * len(true), k
        assert np.sqrt(np.mean(away**2)) < 0.25, k
        assert np.array_equal(detect(board, image).pixels, detection.pixels)
