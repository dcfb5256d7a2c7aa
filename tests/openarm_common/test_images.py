# SPDX-License-Identifier: Apache-2.0
"""Image messages to numpy: encodings, compressed images, camera_info."""

from __future__ import annotations

import array
import contextlib
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, Image

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import info_from_intrinsics
from openarm_common.ros.images import (
    LAYOUTS,
    array_to_image,
    depth_image,
    grey_image,
    image_to_array,
    lens_from_info,
    rgb_image,
    rotation_from_info,
)
from tests.refusals import refused


@pytest.mark.parametrize("encoding", sorted(LAYOUTS))
def test_images_round_trip_without_loss(encoding: str) -> None:
    dtype, channels = LAYOUTS[encoding]
    rng = np.random.default_rng(0)
    pixels = (rng.random((6, 6, channels) if channels > 1 else (6, 6)) * 200).astype(dtype)
    message = array_to_image(pixels, encoding, "cam", 5)
    assert np.array_equal(image_to_array(message), pixels)
    assert message.header.frame_id == "cam"


def test_rows_with_padding_are_read() -> None:
    message = Image(height=2, width=3, encoding="mono8", step=4)
    message.data = bytes([1, 2, 3, 0, 4, 5, 6, 0])
    assert np.array_equal(image_to_array(message), [[1, 2, 3], [4, 5, 6]])


def test_big_endian_depth_is_read() -> None:
    message = Image(height=1, width=2, encoding="16UC1", step=4, is_bigendian=1)
    message.data = bytes([0x03, 0xE8, 0x00, 0x01])
    assert np.array_equal(image_to_array(message), [[1000, 1]])


@pytest.mark.parametrize(("encoding", "size"), [("yuv422", 12), ("mono8", 11), ("rgb8", 12)])
@pytest.mark.requirement("B-28")
def test_a_bad_image_is_refused_by_name(encoding: str, size: int) -> None:
    message = Image(height=3, width=4, encoding=encoding, step=4)
    message.data = bytes(size)
    error = refused(None, image_to_array, message)
    assert error.code is Code.BAD_IMAGE
    assert encoding in error.message


@pytest.mark.requirement("A-30")
def test_camera_info_carries_the_intrinsics() -> None:
    k = Intrinsics.from_fovy(640, 480, 60.0)
    assert lens_from_info(info_from_intrinsics(k, "c", 0)) == Lens(k)


def test_an_uncalibrated_camera_is_refused_and_a_lens_is_read() -> None:
    info = info_from_intrinsics(Intrinsics.from_fovy(640, 480, 60.0), "c", 0)
    info.d = [0.1, 0.0, 0.0, 0.0, 0.0]
    assert lens_from_info(info).coefficients == tuple(info.d)
    info.distortion_model = "ftheta"
    refused("'ftheta' with 5 coefficients; models", lens_from_info, info)
    info.k = [0.0] * 9
    refused("not calibrated", lens_from_info, info)


def test_images_of_image_proc_have_the_intrinsics_of_p() -> None:
    info = info_from_intrinsics(Intrinsics.from_fovy(640, 480, 60.0), "c", 0)
    info.d = [0.1, 0.0, 0.0, 0.0, 0.0]
    info.p[0] = 400.0
    found = lens_from_info(info, rectified=True)
    assert (found.straight, found.intrinsics.fx) == (True, 400.0)
    info.p[0] = 0.0
    found = lens_from_info(info, rectified=True)
    assert (found.straight, found.intrinsics.fx) == (True, info.k[0])


def test_binning_and_region_leave_the_lens_of_the_images_that_come() -> None:
    info = info_from_intrinsics(Intrinsics(640, 480, 600.0, 602.0, 318.0, 241.0), "c", 0)
    info.binning_x = info.binning_y = 2
    assert lens_from_info(info).intrinsics == Intrinsics(320, 240, 300.0, 301.0, 159.0, 120.5)
    info.binning_x = info.binning_y = 0
    info.roi.x_offset, info.roi.y_offset, info.roi.width, info.roi.height = 200, 100, 240, 300
    assert lens_from_info(info).intrinsics == Intrinsics(240, 300, 600.0, 602.0, 118.0, 141.0)


def test_the_rotation_of_a_stereo_pair_is_read() -> None:
    info = info_from_intrinsics(Intrinsics.from_fovy(640, 480, 60.0), "c", 0)
    info.r = [0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    assert rotation_from_info(info)[1, 0] == 1.0
    info.r = [0.0] * 9
    assert np.array_equal(rotation_from_info(info), np.eye(3))
    info.r[0] = 2.0
    refused("is no rotation", rotation_from_info, info)


@pytest.mark.parametrize(("name", "ours"), [("Inverse Brown Conrady", "inverse_brown_conrady"), ("", "plumb_bob")])
def test_names_of_models_may_be_written_otherwise(name: str, ours: str) -> None:
    info = info_from_intrinsics(Intrinsics.from_fovy(640, 480, 60.0), "c", 0)
    info.distortion_model, info.d = name, [0.1, 0.0, 0.0, 0.0, 0.0]
    assert lens_from_info(info).model == ours


RED = np.zeros((4, 6, 3), np.uint8)
RED[..., 0], RED[:, 3:, 1] = 200, 90


def bayer(order: str) -> NDArray[np.uint8]:
    """A mosaic of one colour; the order is of the first two rows."""
    out = np.zeros((8, 8), np.uint8)
    for k, letter in enumerate(order):
        out[k // 2 :: 2, k % 2 :: 2] = {"r": 200, "g": 90, "b": 30}[letter]
    return out


@pytest.mark.parametrize(
    ("encoding", "pixels"),
    [
        ("rgb8", RED),
        ("bgr8", RED[..., ::-1]),
        ("8UC3", RED[..., ::-1]),
        ("rgba8", np.dstack([RED, np.full((4, 6), 255, np.uint8)])),
        ("bgra8", np.dstack([RED[..., ::-1], np.zeros((4, 6), np.uint8)])),
        ("rgb16", RED.astype(np.uint16) * 256),
        ("bgr16", RED[..., ::-1].astype(np.uint16) * 256),
    ],
)
@pytest.mark.parametrize("big", [False, True])
@pytest.mark.requirement("M-08")
def test_the_usual_encodings_are_colours(encoding: str, pixels: NDArray[np.generic], big: bool) -> None:
    message = array_to_image(np.ascontiguousarray(pixels), encoding, "c", 0)
    if big:
        message.is_bigendian, message.data = (
            1,
            array.array("B", pixels.astype(pixels.dtype.newbyteorder(">")).tobytes()),
        )
    assert np.array_equal(rgb_image(message), RED)


@pytest.mark.parametrize(
    ("encoding", "order"), [("yuv422", "uyvy"), ("uyvy", "uyvy"), ("yuv422_yuy2", "yuyv"), ("yuyv", "yuyv")]
)
@pytest.mark.requirement("M-08")
def test_yuv_is_colour(encoding: str, order: str) -> None:
    # video levels, as UYVY and YUYV have them
    y, u, v = round(16 + 219 / 255 * (0.299 * 210 + 0.587 * 40 + 0.114 * 60)), *_chroma(210, 40, 60)
    pair = {"uyvy": (u, y, v, y), "yuyv": (y, u, y, v)}[order]
    message = array_to_image(np.tile(np.array(pair, np.uint8).reshape(1, 2, 2), (4, 3, 1)), encoding, "c", 0)
    assert np.abs(rgb_image(message).astype(int) - (210, 40, 60)).max() <= 3
    message.width, message.step = 5, 12
    refused("even number", rgb_image, message)


def _chroma(r: int, g: int, b: int) -> tuple[int, int]:
    """BT.601, video levels."""
    return round(128 - 0.148 * r - 0.291 * g + 0.439 * b), round(128 + 0.439 * r - 0.368 * g - 0.071 * b)


@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
@pytest.mark.requirement("M-08")
def test_colour_in_a_plane_of_its_own_is_colour(encoding: str) -> None:
    """The planes are those of OpenCV's I420, with U and V in turns."""
    rgb = np.zeros((8, 12, 3), np.uint8)
    rgb[:, :6], rgb[4:, 6:] = (210, 40, 60), (20, 180, 90)
    planar = cv2.cvtColor(rgb, cv2.COLOR_RGB2YUV_I420)
    u, v = planar[8:].reshape(2, 4, 6)
    pairs = np.stack((u, v) if encoding == "nv12" else (v, u), axis=-1).reshape(4, 12)
    message = array_to_image(np.vstack([planar[:8], pairs]), encoding, "c", 0)
    assert (message.height, message.step, len(message.data)) == (8, 12, 144)
    assert np.abs(rgb_image(message).astype(int) - rgb).max() <= 3
    message.height = 7
    refused("expected step >= 12 and step × 3/2 height bytes", rgb_image, message)
    message.height, message.width, message.step = 9, 11, 11
    message.data = bytes(11 * 13)
    refused("even number", rgb_image, message)


@pytest.mark.parametrize("order", ["rggb", "bggr", "gbrg", "grbg"])
@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.requirement("M-08")
def test_mosaics_are_colours(order: str, bits: int) -> None:
    pixels = bayer(order) if bits == 8 else bayer(order).astype(np.uint16) * 256 + 77
    rgb = rgb_image(array_to_image(pixels, f"bayer_{order}{bits}", "c", 0))
    assert rgb[4, 4].tolist() == [200, 90, 30]


@pytest.mark.requirement("M-08")
def test_grey_is_grey_in_any_depth() -> None:
    grey = np.arange(24, dtype=np.uint8).reshape(4, 6)
    for encoding, pixels in (("mono8", grey), ("8UC1", grey), ("mono16", grey.astype(np.uint16) * 256 + 7)):
        message = array_to_image(pixels, encoding, "c", 0)
        assert np.array_equal(grey_image(message), grey)
        assert np.array_equal(rgb_image(message)[..., 2], grey)
    refused("colour image is '32FC1'; valid: rgb8", rgb_image, array_to_image(grey.astype(np.float32), "32FC1", "c", 0))
    refused("depth encoding 'mono8'", depth_image, array_to_image(grey, "mono8", "c", 0))


def compressed(form: str, data: bytes) -> CompressedImage:
    return CompressedImage(format=form, data=array.array("B", data))


@pytest.mark.requirement("M-08")
def test_compressed_colour_is_read() -> None:
    png = cv2.imencode(".png", RED[..., ::-1])[1].tobytes()
    for form in ("png", "rgb8; png compressed bgr8", ""):
        assert np.array_equal(rgb_image(compressed(form, png)), RED)
    jpeg = cv2.imencode(".jpg", np.full((16, 16, 3), (60, 40, 210), np.uint8))[1].tobytes()
    assert np.abs(rgb_image(compressed("rgb8; jpeg compressed bgr8", jpeg)).astype(int) - (210, 40, 60)).max() < 6
    assert grey_image(compressed("jpeg", jpeg)).shape == (16, 16)
    refused("damaged|no image", rgb_image, compressed("png", png[: len(png) // 2]))
    refused("which is depth", rgb_image, compressed("16UC1; compressedDepth png", png))


def test_a_png_whose_parts_say_that_they_are_huge_takes_no_memory() -> None:
    png = bytearray(cv2.imencode(".png", RED)[1].tobytes())
    at = png.index(b"IDAT") - 4
    png[at : at + 4] = struct.pack(">I", 2**31 - 8)
    refused("longer than all of it", rgb_image, compressed("png", bytes(png)))


def inverse(depth: NDArray[np.float32], a: float, b: float) -> NDArray[np.uint16]:
    """Quantise depth as compressed_depth_image_transport does."""
    return np.where(np.isfinite(depth), np.rint(a / depth + b), 0).astype(np.uint16)


@pytest.mark.requirement("M-08")
def test_compressed_depth_is_read() -> None:
    z = np.arange(500, 524, dtype=np.uint16).reshape(4, 6)
    head = struct.pack("<iff", 0, 0.0, 0.0)
    png = cv2.imencode(".png", z)[1].tobytes()
    assert np.array_equal(depth_image(compressed("16UC1; compressedDepth png", head + png)), z)
    assert np.array_equal(depth_image(compressed("16UC1; compressedDepth", head + png)), z)
    assert np.array_equal(depth_image(compressed("png", png)), z)
    metres = z.astype(np.float32) / 1000
    metres[1, 2] = np.nan
    a, b = 100.0 * (100.0 / 0.5 + 1.0), 1.0 - 100.0 * (100.0 / 0.5 + 1.0) / 10.0
    data = struct.pack("<iff", 1, a, b) + cv2.imencode(".png", inverse(metres, a, b))[1].tobytes()
    np.testing.assert_allclose(depth_image(compressed("32FC1; compressedDepth png", data)), metres, rtol=1e-4)
    refused("header of 12", depth_image, compressed("16UC1; compressedDepth png", b"123"))
    refused(
        "expected 16 bits",
        depth_image,
        compressed("16UC1; compressedDepth png", head + cv2.imencode(".png", RED)[1].tobytes()),
    )
    refused(
        "compressedDepth, or a PNG of 16 bits", depth_image, compressed("jpeg", cv2.imencode(".jpg", RED)[1].tobytes())
    )


#: Two zeros, three pixels 1000, 1001, 998 and a zero, by hand after Wilson 2017: runs 2 and 3, differences 1000, 1, -3,
#: run 1 and none; nibbles of three bits, the fourth says that more follow.
_RVL = [2, 3, *(8 | 0, 8 | 2, 8 | 7, 3), 2, 5, 1, 0]


@pytest.mark.requirement("M-08")
def test_depth_by_rvl_is_read() -> None:
    words = [0, 0]
    for k, nibble in enumerate(_RVL):
        words[k // 8] |= nibble << (28 - 4 * (k % 8))
    head = struct.pack("<iffii", 0, 0.0, 0.0, 3, 2)
    found = depth_image(compressed("16UC1; compressedDepth rvl", head + struct.pack("<II", *words)))
    assert found.tolist() == [[0, 0, 1000], [1001, 998, 0]]
    refused("damaged or cut", depth_image, compressed("16UC1; compressedDepth rvl", head + struct.pack("<I", words[0])))
    huge = struct.pack("<iffii", 0, 0.0, 0.0, 2**30, 2**30)
    refused("expected PNG, or RVL", depth_image, compressed("16UC1; compressedDepth rvl", huge + bytes(8)))


@given(st.binary(max_size=300), st.sampled_from(["16UC1; compressedDepth rvl", "32FC1; compressedDepth png", "jpeg"]))
def test_no_compressed_image_ends_in_a_raw_error(data: bytes, form: str) -> None:
    for read in (rgb_image, depth_image, grey_image):
        with contextlib.suppress(OpenArmError):
            read(compressed(form, struct.pack("<iffii", 0, 0.0, 0.0, 7, 5) + data))
