# SPDX-License-Identifier: Apache-2.0
"""Frames of a depth camera from image files: colour, depth, intrinsics, pose."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np
import yaml

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.types import Array, Bytes, Floats
from openarm_perception.frames.pcd import MOST_POINTS, read_pcd
from openarm_perception.geometry.depth import Deprojector, DepthLimits, Points

#: Most bytes of a file with an image, and of one with numbers.
_MOST_BYTES, _MOST_TEXT = 256_000_000, 100_000
#: Models of distortion that OpenCV's polynomials are.
_MODELS = ("plumb_bob", "rational_polynomial")
#: An organised cloud is a pinhole camera's when its points are within this of their pixels, rms.
_PINHOLE = 1.0


@dataclass(frozen=True, eq=False)
class Frame:
    """What a depth camera saw.

    Attributes:
        points: (h, w, 3) float32 organised, optical frame, m; NaN where nothing was measured.
        rgb: (h, w, 3) uint8; None without colour.
        intrinsics: Of both.
    """

    points: Points
    rgb: Bytes | None
    intrinsics: Intrinsics


def read_frame(color: Path, depth: Path, info: Path, depth_scale: float, limits: DepthLimits) -> Frame:
    """Read a frame of two aligned images.

    Args:
        color: Image of 8 bits.
        depth: Image of 16 bits with one channel, 0 where nothing was measured.
        info: Intrinsics of both, see `read_intrinsics`.
        depth_scale: Metres of a count.
        limits: Depths that count.

    Raises:
        OpenArmError: BAD_IMAGE, for files that are no such images or do not belong together; INVALID_ARGUMENT, for a
            scale.
    """
    rgb = _read_image(color)
    if rgb.dtype != np.uint8 or rgb.ndim != 3:
        raise _refused(color, f"has {_channels(rgb)}", "a colour image of 8 bits")
    height, width = rgb.shape[:2]
    lens = read_intrinsics(info, (width, height))
    points = read_depth(depth, lens, depth_scale, limits)
    return Frame(points, cv2.cvtColor(rgb[..., :3], cv2.COLOR_BGR2RGB).astype(np.uint8, copy=False), lens)


def read_depth(path: Path, lens: Intrinsics, depth_scale: float, limits: DepthLimits) -> Points:
    """Read a depth image as organised points.

    Args:
        path: Image of 16 bits with one channel, 0 where nothing was measured.
        lens: Intrinsics.
        depth_scale: Metres of a count.
        limits: Depths that count.

    Raises:
        OpenArmError: BAD_IMAGE, for another image or another size; INVALID_ARGUMENT, for a scale.
    """
    if not 1e-6 <= depth_scale <= 1.0:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"depth scale is {depth_scale:g} m a count; expected 0.000001 .. 1, such as 0.001"
        )
    z = _read_image(path)
    if z.dtype != np.uint16 or z.ndim != 2:
        raise _refused(path, f"has {_channels(z)}", "a depth image: one channel of 16 bits")
    if z.shape != (lens.height, lens.width):
        raise _refused(path, f"is {z.shape[1]}x{z.shape[0]} pixels", f"{lens.width}x{lens.height}, as the colour image")
    # as metres, whatever a count is
    return Deprojector(limits).organised(z.astype(np.float32) * np.float32(depth_scale), lens)


def rectified(rgb: Bytes, z: Floats, lens: Intrinsics, d: Array, model: str) -> tuple[Bytes, Floats]:
    """Remove the distortion of a lens from aligned images.

    Args:
        rgb: (h, w, 3) uint8.
        z: (h, w) float32, m, not positive where nothing was measured.
        lens: Intrinsics, before and after.
        d: (n,) coefficients, as of a CameraInfo.
        model: Their name there.

    Raises:
        OpenArmError: BAD_IMAGE, for another model.
    """
    if model not in _MODELS or len(d) not in (4, 5, 8) or not np.isfinite(d).all():
        text = (
            f"distortion model {brief(model)} with {len(d)} coefficients; expected {', '.join(_MODELS)} with 4, 5 or 8"
        )
        raise OpenArmError(Code.BAD_IMAGE, text)
    matrix, size = (
        np.array([[lens.fx, 0.0, lens.cx], [0.0, lens.fy, lens.cy], [0.0, 0.0, 1.0]]),
        (lens.width, lens.height),
    )
    maps = cv2.initUndistortRectifyMap(matrix, d, None, matrix, size, cv2.CV_32FC1)
    # a depth between that of two surfaces is that of none
    depth = cv2.remap(z, *maps, cv2.INTER_NEAREST, borderValue=(0.0,))
    color = cv2.remap(np.ascontiguousarray(rgb), *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return color.astype(np.uint8, copy=False), depth.astype(np.float32, copy=False)


def read_cloud(path: Path, limits: DepthLimits) -> Frame:
    """Read a frame that is an organised cloud in a PCD file; the intrinsics are those that its points fit.

    Args:
        path: Of the file.
        limits: Depths that count.

    Raises:
        OpenArmError: BAD_IMAGE, for what is no such file, or was not seen by a pinhole camera.
    """
    cloud = read_pcd(path)
    lens = intrinsics_of(cloud.points)
    z = cloud.points[..., 2]
    cloud.points[~((z >= limits.near) & (z <= limits.far))] = np.nan
    return Frame(cloud.points, cloud.rgb, lens)


def intrinsics_of(points: Points) -> Intrinsics:
    """Return the intrinsics of the camera that saw organised points (h, w, 3), by least squares.

    Raises:
        OpenArmError: BAD_IMAGE, when they are no image of a pinhole camera without distortion.
    """
    height, width = points.shape[:2]
    v, u = np.nonzero(points[..., 2] > 0.0)
    keep = slice(None, None, max(1, len(v) // 20_000))
    v, u = v[keep], u[keep]
    p = points[v, u].astype(np.float64)
    values: list[float] = []
    off = np.inf
    if len(v) >= 100:
        off = 0.0
        for pixel, ray in ((u, p[:, 0] / p[:, 2]), (v, p[:, 1] / p[:, 2])):
            A = np.column_stack([ray, np.ones(len(ray))])
            (f, c), *_ = np.linalg.lstsq(A, pixel.astype(np.float64), rcond=None)
            off = max(off, float(np.sqrt(np.mean((A @ (f, c) - pixel) ** 2))))
            values += [float(f), float(c)]
    lens = Intrinsics(width, height, values[0], values[2], values[1], values[3]) if values else None
    if lens is None or off > _PINHOLE or lens.fault():
        why = f"fewer than 100 points (of {width}x{height})" if lens is None else f"points {off:.1f} pixels (rms) off"
        raise OpenArmError(
            Code.BAD_IMAGE,
            f"the cloud has {why} the image of a pinhole camera; expected x right, y down, z forward in the optical"
            " frame, a point per pixel",
        )
    return lens


def read_intrinsics(path: Path, size: tuple[int, int]) -> Intrinsics:
    """Read intrinsics: YAML of a CameraInfo (`k`, or `camera_matrix: data`), of fx, fy, cx, cy, or three rows of text.

    Images must be rectified: coefficients of distortion are not used.

    Args:
        path: Of the file.
        size: (width, height) of the images, which the file must have too where it says one.

    Raises:
        OpenArmError: BAD_IMAGE, for another file or another size.
    """
    expected = "YAML with fx, fy, cx, cy, or k or camera_matrix of nine numbers, or three rows of three numbers"
    data = _read_text(path)
    matrix = _rows(data, 3)
    if matrix is None:
        content = _mapping(data, path, expected)
        if all(name in content for name in ("fx", "fy", "cx", "cy")):
            fx, fy, cx, cy = (_number(content[name], path, expected) for name in ("fx", "fy", "cx", "cy"))
        else:
            k = content.get("k", content.get("K", content.get("camera_matrix")))
            k = cast(dict[str, Any], k).get("data") if isinstance(k, dict) else k
            if not isinstance(k, list) or len(cast(list[Any], k)) != 9:
                raise _refused(path, f"has the keys {', '.join(sorted(map(str, content)))[:80] or 'none'}", expected)
            numbers = [_number(value, path, expected) for value in cast(list[Any], k)]
            fx, fy, cx, cy = numbers[0], numbers[4], numbers[2], numbers[5]
        for given, name, other in ((size[0], "width", "image_width"), (size[1], "height", "image_height")):
            said = content.get(name, content.get(other, given))
            if said != given:
                raise _refused(path, f"is of images with {name} {str(said)[:20]}", f"{given}, that of the images")
    else:
        fx, fy, cx, cy = matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2]
    lens = Intrinsics(*size, float(fx), float(fy), float(cx), float(cy))
    if fault := lens.fault():
        raise _refused(path, f"gives {fault}", "the intrinsics of a camera")
    return lens


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
    if not np.allclose(pose, matrix, atol=1e-3) or np.linalg.det(u @ vt) < 0.0 or np.abs(pose[:3, 3]).max() > 1e3:
        raise _refused(path, "has a matrix that is no pose", expected)
    return pose


def _read_image(path: Path) -> Any:
    from PIL import Image, UnidentifiedImageError

    try:
        if path.stat().st_size > _MOST_BYTES:
            raise _refused(path, f"has {path.stat().st_size} bytes", f"at most {_MOST_BYTES}")
        data = path.read_bytes()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(path) as head:  # its size, before anything is unpacked
                width, height = head.size
    except OSError as error:
        what = (
            "is no image" if isinstance(error, UnidentifiedImageError) else f"can't be read: {error.strerror or error}"
        )
        raise _refused(path, what, "a PNG file") from error
    except (Image.DecompressionBombError, ValueError, SyntaxError) as error:
        raise _refused(path, "is no image of a camera", "a PNG file") from error
    if width * height > MOST_POINTS or min(width, height) < 8:
        raise _refused(path, f"is {width}x{height} pixels", f"8x8 to {MOST_POINTS} pixels")
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None:
        raise _refused(path, "is damaged or of an unknown format", "a PNG file")
    return image


def _channels(image: Any) -> str:
    return f"{1 if image.ndim == 2 else image.shape[2]} channel(s) of {8 * image.dtype.itemsize} bits"


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


def _mapping(text: str, path: Path, expected: str) -> dict[str, Any]:
    try:
        # `ros2 topic echo` ends each message with a line of its own
        content = next(iter(yaml.safe_load_all(text)), None)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise _refused(path, "is no YAML", expected) from error
    if not isinstance(content, dict):
        raise _refused(path, "has no keys", expected)
    return cast(dict[str, Any], content)


def _number(value: Any, path: Path, expected: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e9:
        raise _refused(path, f"has {str(value)[:40]!r} among the intrinsics", expected)
    return float(value)


def _refused(path: Path, what: str, expected: str) -> OpenArmError:
    return OpenArmError(Code.BAD_IMAGE, f"{path} {what}; expected {expected}")
