# SPDX-License-Identifier: Apache-2.0
"""Files of intrinsics with distortion: of ROS, OpenCV, Kalibr, librealsense, Open3D, or numbers alone."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens, lens_of
from openarm_common.documents import number, read_cells, read_document
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief

#: Names that files have for the matrix, the distortion, its model, and the size of the image.
_MATRIX = ("camera_matrix", "cameramatrix", "k", "mtx", "intrinsic_matrix", "intrinsics", "matrix")
_FOUR = (("fx", "fy", "cx", "cy"), ("fx", "fy", "ppx", "ppy"))
_DISTORTION = (
    "distortion_coefficients", "distortion", "distcoeffs", "dist_coeffs", "dist", "d", "coefficients", "coeffs",
    "distortion_coeffs",
)  # fmt: skip
_MODEL = ("distortion_model", "model")
#: Coefficients with names of their own.
_FLAT, _FLAT_FISHEYE = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"), ("k1", "k2", "k3", "k4")
#: Words for a projection that is no pinhole's, and ours: OpenCV's, and those of other programs.
_FISHEYE = re.compile(r"fisheye|equidistant|kannala|kb4?$", re.IGNORECASE)
_PINHOLES = re.compile(r"pinhole|perspective|opencv|plumb|brown|radtan|^$", re.IGNORECASE)
_SIZES = (("image_width", "image_height"), ("width", "height"), ("w", "h"))
_EXPECTED = (
    "image_width, image_height, camera_matrix (or K, or fx, fy, cx and cy), and distortion_coefficients (or D) with"
    " distortion_model; or three rows of three numbers"
)


def read_lens(path: Path, size: tuple[int, int] | None = None) -> Lens:
    """Read intrinsics.

    Args:
        path: YAML of a CameraInfo or of camera_calibration_parsers, OpenCV's FileStorage, Kalibr's camchain, JSON of
            Open3D or with librealsense's names, or text: three rows of three numbers, or fx fy cx cy.
        size: Width and height of the images, which the file must have too where it says one; None: the file says it.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the file and what is wrong; BAD_IMAGE, as `lens_of`.
    """
    try:
        if (numbers := _of_text(path)) is not None:
            return _lens(numbers, size, (), "", path)
        entries = _entries(read_document(path), size)
        said = _size(entries)
        if said is None and size is None:
            raise KeyError("image_width")
        if said is not None and size is not None and said != size:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path} is of images of {said[0]}x{said[1]} pixels; expected {size[0]}x{size[1]}, as these are",
            )
        return _lens(_matrix(entries), said or size, *_distortion(entries), path)
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
        why = f"no {error.args[0]}" if isinstance(error, KeyError) else brief(str(error))
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{path} has no intrinsics of a camera: {why}; expected {_EXPECTED}"
        ) from error


def _lens(k: list[float], size: tuple[int, int] | None, d: list[float] | tuple[()], model: str, path: Path) -> Lens:
    if size is None:
        raise ValueError("it does not say the size of the image")
    if len(k) == 4:
        k = [k[0], 0.0, k[2], 0.0, k[1], k[3], 0.0, 0.0, 1.0]
    if len(k) != 9:
        raise ValueError(f"the matrix has {len(k)} numbers, expected 9")
    return lens_of(size, k, model, d, str(path))


def _distortion(entries: Mapping[str, Any]) -> tuple[list[float], str]:
    """Return the coefficients and their model.

    Raises:
        ValueError: A projection that is neither a pinhole's nor a fisheye's.
    """
    projection = str(entries.get("camera_model", ""))
    fisheye = bool(entries.get("fisheye_model")) or _FISHEYE.search(projection) is not None
    if not (fisheye or _PINHOLES.search(projection)):
        raise ValueError(f"its camera_model is {projection!r}, expected pinhole or fisheye")
    d = _listed(_named(entries, _DISTORTION, ()))
    flat = _FLAT_FISHEYE if fisheye else _FLAT
    if not d and "k1" in entries:
        d = [float(entries.get(name, 0.0)) for name in flat]
        d = d if fisheye or any(d[5:]) else d[:5]
    model = str(_named(entries, _MODEL, "equidistant" if fisheye else "plumb_bob"))
    return d, model.rpartition(".")[2]


def _of_text(path: Path) -> list[float] | None:
    """Return the numbers of a text that is a matrix, or fx, fy, cx and cy; None for another file."""
    if path.suffix in (".npz", ".npy", ".xml", ".json"):
        return None
    try:
        cells = read_cells(path)
    except OpenArmError:
        return None
    rows = [[number(cell) for cell in row] for row in cells.rows]
    shape = (len(rows), len(rows[0]) if rows else 0)
    if cells.header or len({len(row) for row in rows}) != 1 or any(None in row for row in rows):
        return None
    if shape in ((3, 3), (3, 4), (4, 4)):
        rows = [row[:3] for row in rows[:3]]
    elif shape not in ((1, 9), (1, 4), (4, 1)):
        return None
    return cast("list[float]", [value for row in rows for value in row])


def _entries(document: Any, size: tuple[int, int] | None) -> dict[str, Any]:
    """Return the entries of the mapping that has the matrix, with those around it; names in lower case.

    Of several cameras the one that is of this size.

    Raises:
        TypeError: A document without names.
        ValueError: Several cameras.
    """
    if isinstance(document, list):  # messages, as ROS prints them
        document = next(iter(cast("list[Any]", document)), None)
    if not isinstance(document, dict):
        raise TypeError("no names")
    outer = _lowered(cast("dict[Any, Any]", document))
    names = {*_MATRIX, "fx"} - {"matrix"}
    if not names.isdisjoint(outer):
        inner = _named(outer, _MATRIX, None)
        return outer | (_lowered(cast("dict[Any, Any]", inner)) if isinstance(inner, dict) and "fx" in inner else {})
    inside = {key: _lowered(cast("dict[Any, Any]", one)) for key, one in outer.items() if isinstance(one, dict)}
    cameras = {key: one for key, one in inside.items() if not names.isdisjoint(one)}
    of_size = {key: one for key, one in cameras.items() if _size(one) == size}
    fitting = of_size if len(cameras) > 1 and of_size else cameras
    if len(fitting) > 1:
        raise ValueError(f"the intrinsics of several cameras: {', '.join(fitting)}; put those of one into a file")
    return outer | next(iter(fitting.values()), {})


def _lowered(entries: Mapping[Any, Any]) -> dict[str, Any]:
    return {str(key).lower(): value for key, value in entries.items()}


def _named(entries: Mapping[str, Any], names: tuple[str, ...], otherwise: Any) -> Any:
    return next((entries[name] for name in names if name in entries), otherwise)


def _matrix(entries: Mapping[str, Any]) -> list[float]:
    """Return nine numbers of K, or fx, fy, cx and cy."""
    value = _named(entries, _MATRIX, None)
    for source in (entries, value):
        for names in _FOUR:
            if isinstance(source, Mapping) and all(name in source for name in names):
                four = cast("Mapping[str, Any]", source)
                return [float(four[name]) for name in names]
    if value is None:
        raise KeyError("camera_matrix")
    return _listed(value)


def _size(entries: Mapping[str, Any]) -> tuple[int, int] | None:
    for width, height in _SIZES:
        if width in entries and height in entries:
            return int(entries[width]), int(entries[height])
    for name in ("image_size", "resolution", "size"):
        if name in entries:
            width, height = _listed(entries[name])
            return int(width), int(height)
    return None


def _listed(value: Any) -> list[float]:
    """Return the numbers of a list, nested or not, or of FileStorage's matrix."""
    if isinstance(value, dict):
        return _listed(cast("dict[str, Any]", value)["data"])
    numbers: list[float] = np.array(value, dtype=np.float64).ravel().tolist()
    return numbers


def camera_info(name: str, optics: Intrinsics) -> str:
    """Return the camera_info YAML of a camera without distortion, as camera_calibration_parsers reads it.

    Args:
        name: Name of the camera.
        optics: Its intrinsics.
    """
    K: Any = optics.matrix.ravel().tolist()
    P: Any = np.hstack([optics.matrix, np.zeros((3, 1))]).ravel().tolist()
    document: dict[str, Any] = {
        "image_width": optics.width,
        "image_height": optics.height,
        "camera_name": name,
        "camera_matrix": {"rows": 3, "cols": 3, "data": K},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
        "rectification_matrix": {"rows": 3, "cols": 3, "data": np.eye(3).ravel().tolist()},
        "projection_matrix": {"rows": 3, "cols": 4, "data": P},
    }
    return yaml.safe_dump(document, sort_keys=False, default_flow_style=None)
