# SPDX-License-Identifier: Apache-2.0
"""Frames of a depth camera from image files: colour, depth, intrinsics, pose."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthImage, check_size, unit_scale
from openarm_common.camera.lens import Lens
from openarm_common.camera.lens_files import read_lens
from openarm_common.camera.pictures import decode_picture, to_bytes
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Bytes, Floats
from openarm_perception.frames.cloud_fields import MOST_POINTS
from openarm_perception.frames.plain import is_image, numbers, read_array
from openarm_perception.geometry.depth import Deprojector, DepthLimits, Points

#: Most bytes of a file with an image, and of one with numbers.
_MOST_BYTES, _MOST_TEXT = 256_000_000, 100_000
#: Cameras are not further from the origin along any axis, m.
_FARTHEST = 10.0


@dataclass(frozen=True, eq=False)
class Frame:
    """What a depth camera saw.

    Attributes:
        points: (h, w, 3) float32 organised, optical frame, m; NaN where nothing was measured.
        rgb: (h, w, 3) uint8; None without colour.
        intrinsics: Intrinsics of both.
        assumed: Metres of a count of depth, where it is not said; None where that is known.
        lens: Lens of the depth image; None where points are of something else.
    """

    points: Points
    rgb: Bytes | None
    intrinsics: Intrinsics
    assumed: float | None = None
    lens: Lens | None = None

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.intrinsics.width, self.intrinsics.height


def read_frame(color: Path, depth: Path, info: Path, depth_scale: float | None, limits: DepthLimits) -> Frame:
    """Read a frame of two aligned images; distortion is removed.

    Args:
        color: Image of colour, or grey.
        depth: Image of depth, see `read_depth`.
        info: Intrinsics of both, see `read_lens`.
        depth_scale: Metres of a count; None as for `metres`.
        limits: Depths that count.

    Raises:
        OpenArmError: BAD_IMAGE, for files that are no such images or do not belong together; CONFIG_INVALID, for
            intrinsics; INVALID_ARGUMENT, for a scale.
    """
    picture = _read_image(color)
    if picture.dtype == np.uint16 and picture.ndim == 2:
        raise _refused(color, f"has {_channels(picture)}", "a colour image; is it the depth?")
    to_rgb = {1: cv2.COLOR_GRAY2RGB, 3: cv2.COLOR_BGR2RGB, 4: cv2.COLOR_BGRA2RGB}
    rgb = cv2.cvtColor(to_bytes(picture), to_rgb[1 if picture.ndim == 2 else picture.shape[2]])
    lens = read_lens(info, (rgb.shape[1], rgb.shape[0]))
    z = _read_counts(depth, lens)
    points = _organised(z, lens, depth_scale, limits)
    rgb = lens.rectified(rgb.astype(np.uint8, copy=False))
    return Frame(points, rgb, lens.intrinsics, assumed(z, depth_scale), lens)


def read_depth(path: Path, lens: Lens, depth_scale: float | None, limits: DepthLimits) -> Points:
    """Read a depth image as organised points, without distortion.

    Args:
        path: Image with one channel of 16 bits, 0 where nothing was measured, or of floats (TIFF); or such a .npy.
        lens: Lens of the camera.
        depth_scale: Metres of a count; None as for `metres`.
        limits: Depths that count.

    Raises:
        OpenArmError: BAD_IMAGE, for another image or another size; INVALID_ARGUMENT, for a scale.
    """
    return _organised(_read_counts(path, lens), lens, depth_scale, limits)


def _organised(counts: DepthImage, lens: Lens, depth_scale: float | None, limits: DepthLimits) -> Points:
    return Deprojector(limits).organised(lens.rectified_depth(metres(counts, depth_scale)), lens.intrinsics)


def is_depth(path: Path) -> bool:
    """Whether an array in a file is a depth image (h, w), and no cloud (n, k)."""
    return path.suffix.lower() == ".npy" and is_image(read_array(path))


def _read_counts(path: Path, lens: Lens) -> DepthImage:
    expected = "a depth image: one channel of 16 bits, or of floats"
    if path.suffix.lower() == ".npy":
        expected += "; (h, w), such as depth.astype(numpy.uint16)"
        z = _checked_size(numbers(read_array(path), path, expected), path)
        kind = np.float32 if z.dtype.kind == "f" else np.uint16 if z.dtype.name == "uint16" else None
        if kind is not None and z.ndim == 2:
            with np.errstate(over="ignore"):
                z = z.astype(kind)
    else:
        z = _read_image(path)
    if z.dtype.name not in ("uint16", "float32") or z.ndim != 2:
        raise _refused(path, f"has {_channels(z)}", expected)
    check_size(str(path), z.shape, lens.intrinsics)
    return z


def metres(counts: DepthImage, scale: float | None) -> Floats:
    """Return a depth image in metres.

    Args:
        counts: (h, w) uint16 or float32.
        scale: Metres of a count; None is that of ROS: 0.001 of integers, 1 of floats.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a scale.
    """
    if scale is not None and not 1e-6 <= scale <= 1.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"depth scale is {scale:g} m a count; expected 0.000001 .. 1, such as 0.001"
        )
    return counts.astype(np.float32) * np.float32(unit_scale(counts) if scale is None else scale)


def assumed(counts: DepthImage, scale: float | None) -> float | None:
    """Return the metres of a count that `metres` assumes; None where the scale is given."""
    return unit_scale(counts) if scale is None else None


def read_pose(path: Path) -> Array:
    """Read the pose (4, 4) of the optical frame in a frame whose z points up: four rows of four numbers, m.

    Raises:
        OpenArmError: BAD_IMAGE, for another file, or what is no pose.
    """
    expected = "four rows of four numbers, a rotation and a translation in metres"
    matrix = _rows(_read_text(path), 4)
    if matrix is None:
        raise _refused(path, "has something else", expected)
    # printed with few digits a rotation is none to the last one
    u, _, vt = np.linalg.svd(matrix[:3, :3])
    pose = se3.make(u @ vt, matrix[:3, 3])
    if not np.allclose(pose, matrix, atol=1e-3) or np.linalg.det(u @ vt) < 0.0:
        raise _refused(path, "has a matrix that is no pose", expected)
    if np.abs(p := pose[:3, 3]).max() > _FARTHEST:
        said, mm = (" ".join(f"{v:.6g}" for v in values) for values in (p, p / 1e3))
        raise _refused(
            path,
            f"has a translation of {said}",
            f"metres, {_FARTHEST:g} at most from the origin of a frame; where that is millimetres, write {mm} as its"
            " last column",
        )
    return pose


def _read_image(path: Path) -> NDArray[Any]:
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise _refused(path, f"has {path.stat().st_size} bytes", f"at most {_MOST_BYTES}")
        picture = decode_picture(path.read_bytes(), str(path))
    except OSError as error:
        raise _refused(path, f"can't be read: {error.strerror or error}", "a PNG file") from error
    return _checked_size(picture, path)


def _checked_size(picture: NDArray[Any], path: Path) -> NDArray[Any]:
    height, width = picture.shape[:2]
    if width * height > MOST_POINTS or min(width, height) < 8:
        raise _refused(path, f"is {width}x{height} pixels", f"8x8 to {MOST_POINTS} pixels")
    return picture


def _channels(image: Any) -> str:
    return f"{1 if image.ndim == 2 else image.shape[2]} channel(s) of {image.dtype.name}"


def _read_text(path: Path) -> str:
    try:
        with path.open("rb") as file:
            data = file.read(_MOST_TEXT + 1)
    except OSError as error:
        raise _refused(path, f"can't be read: {error.strerror}", "a file") from error
    if len(data) > _MOST_TEXT:
        raise _refused(path, f"has more than {_MOST_TEXT} bytes", "a short text")
    return data.decode("utf-8", errors="replace")


def _rows(text: str, size: int) -> Array | None:
    """Return a square matrix of numbers that is all that a text has; None for another text."""
    rows = [line.replace(",", " ").split() for line in text.splitlines() if line.strip()]
    if len(rows) != size or any(len(row) != size for row in rows):
        return None
    try:
        matrix = np.array([[float(word) for word in row] for row in rows])
    except ValueError:
        return None
    return matrix if np.isfinite(matrix).all() else None


def _refused(path: Path, what: str, expected: str) -> OpenArmError:
    return OpenArmError(Code.BAD_IMAGE, f"{path} {what}; expected {expected}")
