# SPDX-License-Identifier: Apache-2.0
"""Every path that takes the distortion of a lens out gives the pixels of OpenCV and librealsense, to 0.05 px."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from rclpy.serialization import serialize_message
from sensor_msgs.msg import CameraInfo

from openarm_bringup.bags.bag import BagWriter
from openarm_bringup.bags.ros.listener import from_profile
from openarm_bringup.ros.camera_frame import frames_of_bag
from openarm_calibration.board.board import parse_board
from openarm_calibration.board.detect import detect_undistorted
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import lens_of
from openarm_common.camera.lens_files import read_lens
from openarm_common.errors import Code
from openarm_common.ros.convert import info_from_intrinsics
from openarm_common.ros.images import array_to_image, color_of, depth_of, lens_from_info
from openarm_common.ros.node import QOS_SENSOR
from openarm_hardware.cameras.config import UsbConfig
from openarm_hardware.cameras.usb import UsbCamera
from openarm_perception.frames.images import read_frame
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.ros.frames import CameraChoice
from openarm_perception.stereo.rectification import Rectification, Rectified
from tests.lens_grid import MODELS, SIZE, STRAIGHT, K, calibration, drawn, librealsense, off, shown
from tests.refusals import refused

pytestmark = pytest.mark.requirement("M-01")

OPTICS = Intrinsics(*SIZE, K[0, 0], K[1, 1], K[0, 2], K[1, 2])
MOST = 0.05


def info_of(model: str) -> CameraInfo:
    info = info_from_intrinsics(OPTICS, "c", 0)
    info.distortion_model, info.d = model, list(MODELS[model])
    return info


def lens(model: str):
    return lens_of(SIZE, K.ravel().tolist(), model, MODELS[model], "the test")


def by_files(model: str, rgb: NDArray[np.uint8], folder: Path) -> NDArray[np.uint8]:
    cv2.imwrite(str(folder / "c.png"), rgb)
    cv2.imwrite(str(folder / "z.png"), np.full(SIZE[::-1], 500, np.uint16))
    (folder / "k.yaml").write_text(calibration(model))
    frame = read_frame(folder / "c.png", folder / "z.png", folder / "k.yaml", None, DepthLimits())
    assert frame.rgb is not None
    return frame.rgb


def by_bag(model: str, rgb: NDArray[np.uint8], folder: Path) -> NDArray[np.uint8]:
    topics = ("/c/color/image_raw", "/c/depth/image_raw", "/c/color/camera_info")
    depth = array_to_image(np.full(SIZE[::-1], 500, np.uint16), "16UC1", "c", 0)
    with BagWriter(folder / "bag", {}) as bag:
        for topic, message in zip(topics, (array_to_image(rgb, "rgb8", "c", 0), depth, info_of(model)), strict=True):
            bag.add_topic(topic, f"sensor_msgs/msg/{type(message).__name__}", from_profile(QOS_SENSOR))
            bag.write(topic, 0, serialize_message(message))
    _, frame = next(frames_of_bag(folder / "bag", CameraChoice(), 0.0))
    assert frame.rgb is not None
    return frame.rgb


def by_topics(model: str, rgb: NDArray[np.uint8], _: Path) -> NDArray[np.uint8]:
    return color_of(array_to_image(rgb, "rgb8", "c", 0), lens_from_info(info_of(model)))


def by_stereo(model: str, rgb: NDArray[np.uint8], _: Path) -> NDArray[np.uint8]:
    left = np.hstack([K, np.zeros((3, 1))])
    right = left.copy()
    right[0, 3] = -0.06 * K[0, 0]
    pair = (Rectified(lens_from_info(info_of(model)), np.eye(3), P) for P in (left, right))
    return Rectification(*pair).rectify(rgb, rgb)[0]


def by_usb(model: str, rgb: NDArray[np.uint8], folder: Path) -> NDArray[np.uint8]:
    cv2.imwrite(str(folder / "frame_00.png"), rgb)
    (folder / "k.yaml").write_text(calibration(model))
    camera = UsbCamera(
        UsbConfig.model_validate(
            {
                "width": SIZE[0],
                "height": SIZE[1],
                "device": str(folder / "frame_%02d.png"),
                "calibration": str(folder / "k.yaml"),
            }
        )
    )
    camera.open()
    frame = camera.read(1.0)
    camera.close()
    assert frame is not None
    return frame.color


@pytest.mark.parametrize("path", [by_files, by_bag, by_topics, by_usb, by_stereo])
@pytest.mark.parametrize("model", MODELS)
def test_a_grid_is_where_a_camera_without_distortion_shows_it(
    model: str, path: Callable[[str, NDArray[np.uint8], Path], NDArray[np.uint8]], tmp_path: Path
) -> None:
    rgb = np.repeat(drawn(shown(model))[..., None], 3, axis=2)
    assert off(rgb[..., 0]) > 1.0
    assert off(path(model, rgb, tmp_path)[..., 0]) < MOST


@pytest.mark.parametrize("model", MODELS)
def test_marks_of_a_board_are_moved_to_the_same_places(model: str) -> None:
    assert np.abs(lens(model).undistorted(shown(model)) - STRAIGHT).max() < MOST


def test_the_pixels_of_librealsense_are_those_of_opencv() -> None:
    rs, optics = librealsense("inverse_brown_conrady")
    grid = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 719, 9)), axis=-1).reshape(-1, 2)
    points = np.array([rs.rs2_deproject_pixel_to_point(optics, list(pixel), 1.0) for pixel in grid])
    straight = points[:, :2] @ K[:2, :2] + K[:2, 2]
    assert np.abs(lens("inverse_brown_conrady").undistorted(grid) - straight).max() < MOST


def test_depth_is_moved_like_colour_and_not_mixed() -> None:
    model = "plumb_bob"
    z = np.where(drawn(shown(model)) > 100, 700, 500).astype(np.uint16)
    depth = depth_of(array_to_image(z, "16UC1", "c", 0), lens(model))
    assert set(np.unique(depth)) <= {0, 500, 700}
    assert off(np.where(depth == 700, 255, 0).astype(np.uint8)) < 1.0  # whole pixels


def test_a_board_behind_a_lens_is_found_as_one_without(tmp_path: Path) -> None:
    board = parse_board({"kind": "chessboard", "columns": 6, "rows": 5, "spacing": 0.03}, "board")
    one = np.kron(np.indices((6, 7)).sum(axis=0) % 2, np.ones((60, 60))) * 200 + 30
    plain = np.full(SIZE[::-1], 255, np.uint8)
    plain[150 : 150 + one.shape[0], 400 : 400 + one.shape[1]] = one
    d = lens("plumb_bob")
    v, u = np.indices(plain.shape, np.float64)
    straight = d.undistorted(np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(*plain.shape, 2).astype(np.float32)
    bent = cv2.remap(plain, straight[..., 0], straight[..., 1], cv2.INTER_LINEAR, borderValue=(255.0,))
    seen, kept = detect_undistorted(board, bent.astype(np.uint8), d)
    expected = (np.array([460.0, 210.0]) - 0.5) + 60.0 * np.stack(np.meshgrid(range(6), range(5)), axis=-1)
    assert np.abs(np.sort(seen.pixels, axis=0) - np.sort(expected.reshape(-1, 2), axis=0)).max() < 0.1
    assert np.abs(kept[100:600, 350:900].astype(int) - plain[100:600, 350:900]).mean() < 3.0


@pytest.mark.parametrize(
    ("text", "d"),
    [
        ("image_width: 1280\nimage_height: 720\ncamera_matrix: {rows: 3, cols: 3, data: [653.8315, 0, 652.3585, 0,"
         " 653.0682, 361.8429, 0, 0, 1]}\ndistortion_model: plumb_bob\n"
         "distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0, 0, 0]}\n", (-0.1, 0.01, 0.0, 0.0, 0.0)),
        ("%YAML:1.0\n---\nimage_width: 1280\nimage_height: 720\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
         "   cols: 3\n   dt: d\n   data: [ 653.8315, 0., 652.3585, 0., 653.0682, 361.8429, 0., 0., 1. ]\n", ()),
        ("cam0:\n  camera_model: pinhole\n  intrinsics: [653.8315, 653.0682, 652.3585, 361.8429]\n"
         "  distortion_model: radtan\n  distortion_coeffs: [-0.1, 0.01, 0.0, 0.0]\n  resolution: [1280, 720]\n",
         (-0.1, 0.01, 0.0, 0.0)),
        ("header: {frame_id: c}\nheight: 720\nwidth: 1280\ndistortion_model: equidistant\nd: [-0.02, 0.0, 0.0, 0.0]\n"
         "k: [653.8315, 0.0, 652.3585, 0.0, 653.0682, 361.8429, 0.0, 0.0, 1.0]\n---\n", (-0.02, 0.0, 0.0, 0.0)),
        ("fx: 653.8315\nfy: 653.0682\ncx: 652.3585\ncy: 361.8429\n", ()),
        ("fx: 653.8315\nfy: 653.0682\nppx: 652.3585\nppy: 361.8429\nmodel: distortion.inverse_brown_conrady\n"
         "coeffs: [-0.05, 0.06, 0.0, 0.0, -0.02]\n", (-0.05, 0.06, 0.0, 0.0, -0.02)),
        ("653.8315 0 652.3585\n0\t653.0682 361.8429\n\n0 0 1\n", ()),
        ("653.8315 0 0\n0 653.0682 0\n652.3585 361.8429 1\n", ()),  # by columns
        ("653.8315 653.0682 652.3585 361.8429\n", ()),
        ("653.8315 0 652.3585 0\n0 653.0682 361.8429 0\n0 0 1 0\n", ()),
        ("653.8315 0 652.3585 0 653.0682 361.8429 0 0 1\n", ()),
        ("%YAML 1.2\n---\nimage_width: 1280\nimage_height: 720\ncamera_matrix: !!opencv-matrix\n   rows: 3\n"
         "   cols: 3\n   dt: d\n   data: [653.8315, 0., 652.3585, 0., 653.0682, 361.8429, 0., 0., 1.]\n", ()),
        ("fisheye_model: 1\nimage_width: 1280\nimage_height: 720\ncamera_matrix: {rows: 3, cols: 3, data: [653.8315, 0,"
         " 652.3585, 0, 653.0682, 361.8429, 0, 0, 1]}\ndistortion_coefficients: {rows: 4, cols: 1, data: [-0.02, 0.004,"
         " -0.003, 0.001]}\n", (-0.02, 0.004, -0.003, 0.001)),  # OpenCV's sample camera_calibration
        ("fx: 653.8315\nfy: 653.0682\ncx: 652.3585\ncy: 361.8429\nk1: -0.2\nk2: 0.05\np1: 0.001\np2: 0.0\nk3: -0.01\n",
         (-0.2, 0.05, 0.001, 0.0, -0.01)),
        ("cam0: {intrinsics: [400, 400, 320, 240], resolution: [640, 480], camera_model: pinhole}\n"
         "cam1: {intrinsics: [653.8315, 653.0682, 652.3585, 361.8429], resolution: [1280, 720]}\n", ()),
        ('{"width": 1280, "height": 720, "intrinsic_matrix": [653.8315, 0, 0, 0, 653.0682, 0, 652.3585, 361.8429, 1]}',
         ()),  # Open3D's, by columns
    ],
)  # fmt: skip
def test_intrinsics_of_others_are_read(text: str, d: tuple[float, ...], tmp_path: Path) -> None:
    path = tmp_path / ("k.json" if text.startswith("{") else "k.yaml")
    path.write_text(text)
    found = read_lens(path, SIZE)
    assert found.intrinsics == OPTICS
    assert found.coefficients == d
    assert found.fisheye == ("fisheye" in text or "equidistant" in text)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "has no intrinsics"),
        ("- 1", "has no intrinsics"),
        ("fx: 20", "no camera_matrix"),
        ("fx: a\nfy: 1\ncx: 1\ncy: 1", "has no intrinsics"),
        ("fx: .nan\nfy: 1\ncx: 1\ncy: 1", "fx=nan"),
        ("fx: 0\nfy: 21\ncx: 7\ncy: 5", "fx=0"),
        ("k: [1, 2]", "has 2 numbers, expected 9"),
        ("width: 640\nheight: 480\nfx: 20\nfy: 21\ncx: 7\ncy: 5", "640x480 pixels; expected 1280x720"),
        ("a: &a [*a]\nb: [", "not valid YAML|no YAML"),
        ("20 0 x\n0 21 5\n0 0 1", "has no intrinsics"),
        ("fx: 20\nfy: 21\ncx: 640\ncy: 360\nd: [1, 2, 3]", "3 coefficients; models"),
        ("fx: 20\nfy: 21\ncx: 640\ncy: 360\nd: [1, 2, 3, 4]\ndistortion_model: ftheta", "'ftheta'"),
        ("fx: 20\nfy: 21\ncx: 640\ncy: 360\ncamera_model: omni", "camera_model is 'omni'"),
        ("fx: 900\nfy: 900\ncx: 1280\ncy: 720\n", r"cx = 1280 of 1280x720 .* of about 2560x1440 pixels"),
        ("a: {fx: 900, fy: 900, cx: 640, cy: 360}\nb: {fx: 600, fy: 600, cx: 640, cy: 360}\n", "several cameras: a, b"),
    ],
)
def test_other_files_are_no_intrinsics(text: str, said: str, tmp_path: Path) -> None:
    (tmp_path / "k.yaml").write_text(text)
    assert refused(said, read_lens, tmp_path / "k.yaml", SIZE).code in (Code.CONFIG_INVALID, Code.BAD_IMAGE)
