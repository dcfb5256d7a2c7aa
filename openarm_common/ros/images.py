# SPDX-License-Identifier: Apache-2.0
"""Image messages to numpy and back: the encodings of ROS, compressed images, lenses of CameraInfo.

An array becomes the data of a message through `array.array`, which rclpy takes without a check of each element (an
ndarray costs 187 ms for a 640×480 depth image, an `array.array` 0.2 ms); data are read through views without a copy.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from openarm_common.camera.lens import Lens, lens_of
from openarm_common.camera.pictures import decode_depth, decode_picture, to_bytes
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.ros.convert import byte_array, header
from openarm_common.types import Array, Bytes, Floats

AnyImage = Image | CompressedImage

#: Encodings of colour and grey: dtype, channels, and what `cv2.cvtColor` makes RGB with; None: it is.
_COLORS: dict[str, tuple[type[np.generic], int, int | None]] = {
    "rgb8": (np.uint8, 3, None),
    "bgr8": (np.uint8, 3, cv2.COLOR_BGR2RGB),
    "8UC3": (np.uint8, 3, cv2.COLOR_BGR2RGB),  # as OpenCV orders it
    "rgba8": (np.uint8, 4, cv2.COLOR_RGBA2RGB),
    "bgra8": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "8UC4": (np.uint8, 4, cv2.COLOR_BGRA2RGB),
    "mono8": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "8UC1": (np.uint8, 1, cv2.COLOR_GRAY2RGB),
    "rgb16": (np.uint16, 3, None),
    "bgr16": (np.uint16, 3, cv2.COLOR_BGR2RGB),
    "mono16": (np.uint16, 1, cv2.COLOR_GRAY2RGB),
    "yuv422": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (np.uint8, 2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (np.uint8, 2, cv2.COLOR_YUV2RGB_YUY2),
    "bayer_rggb8": (np.uint8, 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr8": (np.uint8, 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg8": (np.uint8, 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg8": (np.uint8, 1, cv2.COLOR_BayerGRBG2RGB),
    "bayer_rggb16": (np.uint16, 1, cv2.COLOR_BayerRGGB2RGB),
    "bayer_bggr16": (np.uint16, 1, cv2.COLOR_BayerBGGR2RGB),
    "bayer_gbrg16": (np.uint16, 1, cv2.COLOR_BayerGBRG2RGB),
    "bayer_grbg16": (np.uint16, 1, cv2.COLOR_BayerGRBG2RGB),
    "nv12": (np.uint8, 1, cv2.COLOR_YUV2RGB_NV12),
    "nv21": (np.uint8, 1, cv2.COLOR_YUV2RGB_NV21),
}
#: Encodings with brightness of all pixels, and below it colour of each two by two, in half as many rows.
_SEMI_PLANAR = ("nv12", "nv21")
#: Encodings in which pixels next to each other share their colour.
_PAIRED = ("yuv422", "uyvy", "yuv422_yuy2", "yuyv", *_SEMI_PLANAR)
_DEPTHS: dict[str, type[np.generic]] = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
#: Names of images without distortion, while their CameraInfo is that of the lens, as those of image_proc. What a
#: RealSense calls image_rect_raw is as its CameraInfo says.
_RECTIFIED = re.compile(r"(^|[/_])rect(ified)?(?!_raw)([/_]|$)")
#: dtype and channels by encoding.
LAYOUTS = {name: (dtype, channels) for name, (dtype, channels, _) in _COLORS.items()} | {
    name: (dtype, 1) for name, dtype in _DEPTHS.items()
}


def image_to_array(message: Image) -> NDArray[np.generic]:
    """View an image as an array (height, width) or (height, width, channels), dtype by encoding; not a copy.

    One whose colour is in a plane of its own, such as nv12, is (3/2 height, width).

    Raises:
        OpenArmError: BAD_IMAGE, when the encoding is unknown or the data do not have the size that the header says.
    """
    if message.encoding not in LAYOUTS:
        raise _bad_image(f"image encoding {brief(message.encoding)} is not supported; valid: {', '.join(LAYOUTS)}")
    dtype, channels = LAYOUTS[message.encoding]
    size = np.dtype(dtype).itemsize
    row = message.width * channels * size
    planar = message.encoding in _SEMI_PLANAR
    height = message.height + (message.height // 2 if planar else 0)
    if message.height == 0 or row == 0 or message.step < row or len(message.data) != message.step * height:
        raise _bad_image(
            f"image {message.width}×{message.height} {message.encoding} has step {message.step} and {len(message.data)}"
            f" bytes, expected step >= {row} and step × {'3/2 ' if planar else ''}height bytes"
        )
    if message.encoding in _PAIRED and (message.width % 2 or (planar and message.height % 2)):
        raise _bad_image(f"image {message.encoding} is {message.width}×{message.height} pixels, expected even numbers")
    rows = np.frombuffer(message.data, dtype=np.uint8).reshape(height, message.step)[:, :row]
    pixels = rows if rows.flags.c_contiguous else np.ascontiguousarray(rows)
    shape = (height, message.width, channels) if channels > 1 else (height, message.width)
    if size > 1 and bool(message.is_bigendian) != (sys.byteorder == "big"):
        return pixels.view(np.dtype(dtype).newbyteorder()).astype(dtype).reshape(shape)
    return pixels.view(dtype).reshape(shape)


def array_to_image(pixels: NDArray[np.generic], encoding: str, frame_id: str, t_ns: int) -> Image:
    """Make the image message of an array; dtype and channels must be those of the encoding.

    Args:
        pixels: (height, width) or (height, width, channels).
        encoding: Encoding of ROS.
        frame_id: Optical frame.
        t_ns: Stamp.

    Raises:
        OpenArmError: BAD_IMAGE, when they are not.
    """
    dtype, channels = LAYOUTS[encoding]
    if pixels.dtype != dtype or (pixels.shape[2] if pixels.ndim == 3 else 1) != channels:
        raise _bad_image(f"{encoding} needs {channels} × {dtype.__name__}, got {pixels.dtype} {pixels.shape}")
    height, width = pixels.shape[:2]
    height = height * 2 // 3 if encoding in _SEMI_PLANAR else height
    message = Image(header=header(frame_id, t_ns), height=height, width=width, encoding=encoding)
    message.is_bigendian = int(sys.byteorder == "big")
    message.step = width * channels * pixels.itemsize
    message.data = byte_array(pixels)
    return message


def rgb_image(message: AnyImage) -> Bytes:
    """Return a colour or grey image as (height, width, 3), red first; a view where the message has that order.

    Raises:
        OpenArmError: BAD_IMAGE, for a depth image, and as `image_to_array`.
    """
    if isinstance(message, CompressedImage):
        picture = _decoded(message)
        to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
        return _bytes(cv2.cvtColor(to_bytes(picture), to_rgb[1 if picture.ndim == 2 else picture.shape[2]]))
    pixels = image_to_array(message)
    if message.encoding not in _COLORS:
        raise _bad_image(f"colour image is {message.encoding!r}; valid: {', '.join(_COLORS)}")
    _, _, code = _COLORS[message.encoding]
    if code is None:
        return to_bytes(pixels)
    return _bytes(cv2.cvtColor(to_bytes(pixels), code))


def grey_image(message: AnyImage) -> Bytes:
    """Return a colour or grey image as (height, width).

    Raises:
        OpenArmError: BAD_IMAGE, as `rgb_image`.
    """
    if isinstance(message, Image) and message.encoding in ("mono8", "8UC1", "mono16"):
        return np.ascontiguousarray(to_bytes(image_to_array(message)))
    return _bytes(cv2.cvtColor(rgb_image(message), cv2.COLOR_RGB2GRAY))


def depth_image(message: AnyImage) -> NDArray[np.uint16] | Floats:
    """Return a depth image as (height, width) in counts of its encoding: uint16 mm or float32 m; a view.

    Raises:
        OpenArmError: BAD_IMAGE, for another encoding, or from `image_to_array`.
    """
    if isinstance(message, CompressedImage):
        if "compressedDepth" in message.format:
            return decode_depth(bytes(message.data), message.format.partition(";")[0].strip(), "depth image")
        picture = _decoded(message)
        if picture.ndim != 2 or picture.dtype != np.uint16:
            raise _bad_image(
                f"depth image is compressed as {brief(message.format)} of {picture.dtype} {picture.shape}; expected"
                " compressedDepth, or a PNG of 16 bits"
            )
        return cast("NDArray[np.uint16]", picture)
    if message.encoding not in _DEPTHS:
        raise _bad_image(f"depth encoding {message.encoding!r} is not supported; valid: {', '.join(_DEPTHS)}")
    return cast("NDArray[np.uint16]", image_to_array(message))


def _decoded(message: CompressedImage) -> NDArray[Any]:
    if "compressedDepth" in message.format:
        raise _bad_image(f"the image is compressed as {brief(message.format)}, which is depth; expected colour or grey")
    return decode_picture(bytes(message.data), f"image of {message.header.frame_id!r}, {brief(message.format)},")


def _bytes(picture: NDArray[Any]) -> Bytes:
    return picture.astype(np.uint8, copy=False)


def is_rectified(topic: str) -> bool:
    """Whether the images of a topic have no distortion, by its name, whatever their CameraInfo says of the lens."""
    return _RECTIFIED.search(topic) is not None


def lens_from_info(info: CameraInfo, *, rectified: bool = False) -> Lens:
    """Read intrinsics and distortion; the same lens for the same contents.

    R, which turns rays of the lens into the frame of its rectified images, is no part of it: see `rotation_from_info`.

    Args:
        info: CameraInfo of the camera.
        rectified: Whether its images are rectified, as those of image_proc's `image_rect` are: by P then, where it is.

    Raises:
        OpenArmError: BAD_IMAGE, when the camera is not calibrated (K is zero), or has another distortion model.
    """
    size = (
        (info.roi.width or info.width) // max(info.binning_x, 1),
        (info.roi.height or info.height) // max(info.binning_y, 1),
    )
    where = f"camera_info of {info.header.frame_id!r}"
    K = projection_from_info(info)[:, :3] if rectified and info.p[0] > 0.0 else _in_part(info.k, info)
    model, d = ("", ()) if rectified else (info.distortion_model, tuple(info.d))
    return _lens(size, tuple(K.ravel().tolist()), model, d, where)


_lens = lru_cache(maxsize=32)(lens_of)


def projection_from_info(info: CameraInfo) -> Array:
    """Return P (3, 4) of the rectified images."""
    return _in_part(info.p, info)


def rotation_from_info(info: CameraInfo) -> Array:
    """Return R (3, 3), from the frame of the lens to that of its rectified images; where it has none, no rotation.

    Raises:
        OpenArmError: BAD_IMAGE, when it is no rotation.
    """
    R = np.array(info.r, np.float64).reshape(3, 3)
    if not R.any():
        return np.eye(3)
    if not np.abs(R @ R.T - np.eye(3)).max() < 1e-3:
        raise _bad_image(f"R in the camera_info of {info.header.frame_id!r} is no rotation; calibrate it again")
    return R


def _in_part(matrix: Sequence[float], info: CameraInfo) -> Array:
    """Return K or P of the images that binning and region of interest leave of the full resolution, as of REP 104."""
    across, down = max(info.binning_x, 1), max(info.binning_y, 1)
    scale = np.array([[1.0 / across, 0.0, -info.roi.x_offset / across], [0.0, 1.0 / down, -info.roi.y_offset / down]])
    out = np.array(matrix, np.float64).reshape(3, -1)
    with np.errstate(invalid="ignore"):
        out[:2] = scale @ out
    return out


def depth_of(depth: AnyImage, lens: Lens) -> NDArray[np.uint16] | Floats:
    """Return a depth image without distortion, in counts of its encoding.

    Raises:
        OpenArmError: BAD_IMAGE, as `depth_image`, or when it is of another size than the lens.
    """
    return lens.rectified_depth(depth_image(depth))


def color_of(color: AnyImage, lens: Lens) -> Bytes:
    """Return a colour image (h, w, 3) without distortion.

    Raises:
        OpenArmError: BAD_IMAGE, as `rgb_image`, or when it is of another size than the lens.
    """
    return lens.rectified(rgb_image(color))


def _bad_image(message: str) -> OpenArmError:
    return OpenArmError(Code.BAD_IMAGE, message)
