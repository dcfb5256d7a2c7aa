# SPDX-License-Identifier: Apache-2.0
"""Frames of clouds: of an image as they are, others as a camera that is chosen to fit would see them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_perception.frames.cloud_fields import Cloud, refused
from openarm_perception.frames.images import Frame
from openarm_perception.frames.pcd import read_pcd
from openarm_perception.frames.plain import read_npy, read_xyz
from openarm_perception.frames.ply import read_ply
from openarm_perception.frames.projection import WIDEST, fitting_camera, project
from openarm_perception.geometry.depth import UNLIMITED, Deprojector, DepthLimits, Points

Unit = Literal["m", "cm", "mm"]
#: Axes of a cloud with the sensor at their origin: of a camera (x right, y down, z forward), of one in OpenGL (x right,
#: y up, z backward), of a body (x forward, z up: REP-103); or of anything that stands on the ground, the origin
#: anywhere: z up, or y up.
Axes = Literal["optical", "opengl", "body", "base", "base_y"]
_METRES: Mapping[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001}

_READERS: Mapping[str, Callable[[Path], Cloud]] = {
    ".pcd": read_pcd, ".ply": read_ply, ".npy": read_npy, ".xyz": read_xyz, ".xyzrgb": read_xyz, ".asc": read_xyz,
    ".pts": read_xyz, ".txt": read_xyz, ".csv": read_xyz,
}  # fmt: skip
#: What is a cloud or a mesh, too: what to type.
_CONVERTED = "convert it: pdal translate {path} {stem}.ply"
_SAMPLED = "it is a mesh; sample points of it, with open3d: sample_points_uniformly"
_FOREIGN = {
    ".las": _CONVERTED, ".laz": _CONVERTED, ".e57": _CONVERTED, ".ptx": _CONVERTED,
    ".obj": _SAMPLED, ".stl": _SAMPLED, ".off": _SAMPLED, ".glb": _SAMPLED, ".gltf": _SAMPLED, ".dae": _SAMPLED,
    ".npz": "it is an archive; save one of its arrays: np.save('{stem}.npy', np.load('{path}')['points'])",
}  # fmt: skip
#: An organised cloud is a pinhole camera's when its points are within this of their pixels, rms.
_PINHOLE = 0.5
#: Median distances of points that are none in metres, and of those whose numbers are too large for millimetres.
_FAR_M, _NEAR_M, _ASTRAY = 20.0, 0.02, 10_000.0
#: Share of the points that lie before a camera, if they are its own; and smallest cloud.
_AHEAD, _LEAST = 0.9, 100
#: Points that are asked for their distance, and whether they lie before the camera.
_ASKED = 100_000
#: Height of the camera over the highest point of a cloud with z up, m; more over a wide one.
_ABOVE = 1.0
#: Axes of the optical frame in those of a camera's cloud, and what lies forward there.
_CAMERAS: Mapping[Axes, tuple[Array, str]] = {
    "optical": (np.eye(3), "z"),
    "opengl": (np.diag([1.0, -1.0, -1.0]), "-z"),
    "body": (np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), "x"),
}
_R_Z_UP_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class CloudFrame:
    """A frame of a cloud.

    Attributes:
        frame: The frame; depths are not limited.
        T_base_camera: (4, 4) optical frame in that of the cloud, where its z is up; None: the cloud is of a camera.
        note: Note on how it was made, where it is no image as it is.
    """

    frame: Frame
    T_base_camera: Array | None
    note: str


def is_cloud(path: Path) -> bool:
    """Whether a file is a cloud by its name."""
    return path.suffix.lower() in (*_READERS, *_FOREIGN)


def read_cloud(
    path: Path, limits: DepthLimits, unit: Unit = "m", axes: Axes = "optical", like: CloudFrame | None = None
) -> CloudFrame:
    """Read a cloud.

    Args:
        path: PCD, PLY, .npy or .xyz.
        limits: Depths that count when a camera is chosen.
        unit: Unit of its coordinates.
        axes: Axes of its frame.
        like: A cloud of the same place, whose camera is taken where this is no image.

    Raises:
        OpenArmError: BAD_IMAGE, for another file, and where unit or axes do not fit; it says what to type.
    """
    reader = _READERS.get(path.suffix.lower())
    if reader is None:
        how = _FOREIGN[path.suffix.lower()].format(path=path.name, stem=path.stem)
        raise refused(path, f"is a file {path.suffix}", f"{', '.join(_READERS)}; {how}")
    cloud = reader(path)
    cloud = Cloud(_metres(cloud.points, unit, limits.far, path), cloud.rgb, cloud.label)
    if axes not in _CAMERAS:
        return _from_above(cloud if axes == "base" else _turned(cloud, _R_Z_UP_Y_UP), like)
    _require_ahead(cloud.points, axes, path)
    cloud = _turned(cloud, _CAMERAS[axes][0])
    why = "is no image"
    if cloud.organised:
        try:
            lens = intrinsics_of(cloud.points)
        except OpenArmError:
            why = "is the image of no pinhole camera"
        else:
            return CloudFrame(Frame(cloud.points, cloud.rgb, lens), None, "")
    frame = _projected(cloud, limits, None if like is None else like.frame.intrinsics)
    size = f"{frame.intrinsics.width}x{frame.intrinsics.height}"
    return CloudFrame(frame, None, f"the cloud {why}, and was projected into one of {size}, z forward")


def _turned(cloud: Cloud, R: Array) -> Cloud:
    return Cloud(cloud.points @ R.T.astype(np.float32), cloud.rgb, cloud.label)


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


def _metres(points: Points, unit: Unit, far: float, path: Path) -> Points:
    """Return points in metres; refuse those that can hardly be."""
    scale = np.float32(_METRES[unit])
    some = _some(points)
    distance = np.linalg.norm(some, axis=1)
    distance = distance[np.isfinite(distance)]
    if len(distance) < _LEAST:
        raise refused(path, f"has {len(distance)} points of finite numbers", f"at least {_LEAST}")
    middle = float(np.median(distance)) * float(scale)
    if middle > _ASTRAY:
        x, y, z = (round(float(v)) for v in -np.nanmedian(some, axis=0))
        matrix = f"1 0 0 {x} 0 1 0 {y} 0 0 1 {z} 0 0 0 1"
        raise refused(
            path,
            f"has half of its points farther than {middle / 1e3:.0f} km from its origin",
            f"it near them; type pdal translate {path.name} {path.stem}_near.ply -f filters.transformation"
            f' --filters.transformation.matrix="{matrix}"',
        )
    if unit == "m" and middle > max(_FAR_M, far):
        raise refused(
            path,
            f"has half of its points farther than {middle:.0f} m",
            f"metres; of millimetres type --unit mm, of centimetres --unit cm, else --far {math.ceil(2.0 * middle)}",
        )
    if unit != "m" and middle < _NEAR_M:
        text = f"has half of its points nearer than {middle * 1e3:.2g} mm by --unit {unit}"
        raise refused(path, text, "other units; type --unit m")
    return points * scale


def _some(points: Points) -> Array:
    """Return some of the points (n, 3)."""
    return points.reshape(-1, 3)[:: max(1, points.size // (3 * _ASKED))].astype(np.float64)


def _require_ahead(points: Points, axes: Axes, path: Path) -> None:
    """Refuse points that are not before the camera, and say which axes fit."""
    p = _some(points)
    p = p[np.isfinite(p[:, 0])]
    fit = {name: forward for name, (R, forward) in _CAMERAS.items() if _ahead(p @ R.T)}
    if axes in fit:
        return
    ways = [f"with {forward} forward type --cloud-frame {name}" for name, forward in fit.items()]
    ways += ["where z is up, and no camera at the origin, --cloud-frame base", "where y is up --cloud-frame base_y"]
    what = f"is no cloud of a camera that looks along {_CAMERAS[axes][1]}: too much lies behind it or far aside"
    raise refused(path, what, f"one; {', '.join(ways)}")


def _ahead(points: Array) -> bool:
    before = points[points[:, 2] > 0.0]
    if len(before) < _AHEAD * len(points):
        return False
    low, high = np.percentile(before[:, :2] / before[:, 2:], (2.0, 98.0), axis=0)
    return bool(low.min() > -WIDEST and high.max() < WIDEST)


def _from_above(cloud: Cloud, like: CloudFrame | None) -> CloudFrame:
    """Return what a camera over a cloud with z up sees."""
    points = cloud.points.reshape(-1, 3)
    finite = points[np.isfinite(points[:, 0])].astype(np.float64)
    T = None if like is None else like.T_base_camera
    if T is None:
        middle = (finite.min(axis=0) + finite.max(axis=0)) / 2.0
        above = max(_ABOVE, float(np.ptp(finite[:, :2], axis=0).max()) / WIDEST)
        T = se3.make(np.diag([1.0, -1.0, -1.0]), (middle[0], middle[1], finite[:, 2].max() + above))
    with np.errstate(over="ignore"):
        seen = se3.apply(se3.inverse(T), points.astype(np.float64)).astype(np.float32).reshape(cloud.points.shape)
    lens = None if like is None else like.frame.intrinsics
    frame = _projected(Cloud(seen, cloud.rgb, cloud.label), UNLIMITED, lens)
    size = f"{frame.intrinsics.width}x{frame.intrinsics.height}"
    x, y, z = T[:3, 3]
    note = f"the cloud was projected into an image of {size} of a camera that looks down from {x:.2f} {y:.2f} {z:.2f} m"
    return CloudFrame(frame, T, note)


def _projected(cloud: Cloud, limits: DepthLimits, lens: Intrinsics | None) -> Frame:
    points = np.ascontiguousarray(cloud.points).reshape(-1, 3)
    if lens is None:
        within = points[(points[:, 2] >= limits.near) & (points[:, 2] <= limits.far)]
        lens = fitting_camera(within if len(within) >= _LEAST else points[points[:, 2] > 0.0])
    depth, number = project(points, lens)
    organised = Deprojector(UNLIMITED).organised(depth, lens)
    rgb = None
    if cloud.rgb is not None:
        rgb = np.concatenate([cloud.rgb.reshape(-1, 3), np.zeros((1, 3), np.uint8)])[number]
    return Frame(organised, rgb, lens)
