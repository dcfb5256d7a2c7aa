# SPDX-License-Identifier: Apache-2.0
"""Coarse images and strewn clouds of boxes and cylinders whose sizes are known: rays cut with them, no renderer."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.lens import Lens
from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.frames.cloud_fields import Cloud
from openarm_perception.frames.clouds import read_cloud
from openarm_perception.frames.found import Found, find
from openarm_perception.frames.images import Frame
from openarm_perception.frames.pcd import write_pcd
from openarm_perception.geometry.depth import DepthLimits

LIMITS = DepthLimits(near=0.1, far=3.0)
T_BASE_CAMERA = se3.make(
    se3.rotation_from_z_y((0.1, 0.65, -0.6), np.cross((0.1, 0.65, -0.6), (0.65, -0.1, 0.0))), (-0.08, -0.58, 0.62)
)
#: Box or not, place, yaw, edges or twice the diameter and height; m, rad.
THINGS = [
    (True, (-0.15, -0.05), 0.7, (0.060, 0.080, 0.100)),
    (True, (0.16, -0.03), -0.9, (0.050, 0.062, 0.060)),
    (False, (0.02, 0.09), 0.0, (0.070, 0.070, 0.090)),
]
RNG = np.random.default_rng(3)


def cast(directions: np.ndarray) -> np.ndarray:
    """Depth along rays (n, 3) of unit depth in the optical frame, inf where nothing is: a table of 1.4 by 1 m at 0."""
    o, d = T_BASE_CAMERA[:3, 3], directions @ T_BASE_CAMERA[:3, :3].T
    with np.errstate(all="ignore"):
        t = -o[2] / d[:, 2]
        hit = o + d * t[:, None]
        best = np.where((t > 0) & (np.abs(hit[:, 0]) < 0.7) & (np.abs(hit[:, 1]) < 0.5), t, np.inf)
        for box, (x, y), yaw, edges in THINGS:
            R, half = se3.rot_z(yaw), np.array(edges) / 2
            p, v = (o - (x, y, half[2])) @ R, d @ R
            first, last = np.sort([(-half - p) / v, (half - p) / v], axis=0)
            if not box:
                a, b, c = (v[:, :2] ** 2).sum(1), v[:, :2] @ p[:2], p[:2] @ p[:2] - half[0] ** 2
                root = np.sqrt(b * b - a * c)
                first, last = (
                    np.column_stack([s, z[:, 2]]) for s, z in (((-b - root) / a, first), ((-b + root) / a, last))
                )
            first, last = first.max(1), last.min(1)
            best = np.where((first < last) & (first > 0) & (first < best), first, best)
    return best


def image(scale: int) -> tuple[np.ndarray, Intrinsics]:
    """Organised points of whole millimetres of depth (h, w, 3), of every scale-th pixel of 640 by 480."""
    lens = Intrinsics(640 // scale, 480 // scale, 460 / scale, 460 / scale, 319.5 / scale, 239.5 / scale)
    x, y = np.meshgrid(*lens.rays)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    z = np.round(cast(rays.reshape(-1, 3)) * 1e3).reshape(x.shape) * 1e-3
    return (rays * np.where(np.isfinite(z), z, np.nan)[..., None]).astype(np.float32), lens


def dense() -> np.ndarray:
    points = image(1)[0].reshape(-1, 3)
    return points[np.isfinite(points[:, 2])]


def voxels(edge: float) -> np.ndarray:
    """As PCL's VoxelGrid: the mean of the points of each cell."""
    points = dense().astype(np.float64)
    _, cell, count = np.unique(np.floor(points / edge), axis=0, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(cell.ravel(), points[:, i]) / count for i in range(3)], axis=1)


def some(share: float) -> np.ndarray:
    points = dense()
    return points[RNG.random(len(points)) < share]


def lidar(azimuth: float, elevation: float) -> np.ndarray:
    """Rows of a lidar, with points nearer to each other than the rows; rad."""
    a, e = (angles.ravel() for angles in np.meshgrid(np.arange(-0.6, 0.6, azimuth), np.arange(-0.5, 0.5, elevation)))
    rays = np.column_stack([np.tan(a), np.tan(e) / np.cos(a), np.ones_like(a)])
    z = cast(rays)
    return (rays * z[:, None])[np.isfinite(z)]


def sizes_are_known(found: Found, least_prisms: int) -> None:
    clusters = found.segmentation.clusters
    assert len(clusters) == len(THINGS)
    for _, place, _, edges in THINGS:
        one = min(clusters, key=lambda one: np.hypot(*(one.T_frame_box[:2, 3] - place)))
        off = np.abs(one.size - (*sorted(edges[:2]), edges[2]))
        assert off.max() < found.known_to(one), (one.shape.why, edges, one.size)
    assert sum(one.shape.kind != "unknown" for one in clusters) >= least_prisms


COLORS = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))


@pytest.mark.parametrize("scale", [1, 2, 4])
def test_sizes_are_right_to_a_fraction_of_a_pixel_in_images_of_any_resolution(scale: int) -> None:
    """Of 4 pixels a side, focal lengths 460, 230 and 115."""
    points, lens = image(scale)
    found = find(Frame(points, None, lens), LIMITS, COLORS, T_BASE_CAMERA)
    sizes_are_known(found, 3)
    for one in found.segmentation.clusters:
        assert found.known_to(one) == pytest.approx(1.5 * 0.85 / lens.fx, rel=0.2)
        assert found.as_json()["clusters"][one.id - 1]["known_to"] == pytest.approx(found.known_to(one), abs=1e-5)
    assert 0.8 / lens.fx < np.mean(found.spacing) < 1.1 / lens.fx


@pytest.mark.parametrize(
    ("points", "prisms"),
    [(lambda: voxels(0.005), 3), (lambda: voxels(0.010), 1), (lambda: some(0.2), 3), (lambda: lidar(0.003, 0.008), 2)],
    ids=["voxels of 5 mm", "voxels of 10 mm", "one in five", "lidar"],
)
def test_sizes_in_strewn_clouds_are_as_exact_as_is_said(
    tmp_path: Path, points: Callable[[], np.ndarray], prisms: int
) -> None:
    write_pcd(tmp_path / "a.pcd", Cloud(points()[None].astype(np.float32), None, None))
    sizes_are_known(find(read_cloud(tmp_path / "a.pcd", LIMITS).frame, LIMITS, COLORS, T_BASE_CAMERA), prisms)


@pytest.mark.parametrize("share", [1.0, 0.06])
def test_an_organised_cloud_of_a_lens_with_distortion_is_no_pinhole_image(tmp_path: Path, share: float) -> None:
    """As drivers give it whose depth is not rectified; with less distortion it is nearly one."""
    coefficients = tuple(share * k for k in (0.12, -0.25, 0.0008, -0.0006, 0.08))
    lens = Lens(image(1)[1], "plumb_bob", coefficients)
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    straight = lens.undistorted(np.stack([u, v], axis=-1).reshape(-1, 2))
    rays = lens.intrinsics.deproject(straight, np.ones(u.size))
    z = cast(rays)
    points = (rays * np.where(np.isfinite(z), z, np.nan)[:, None]).reshape(480, 640, 3).astype(np.float32)
    write_pcd(tmp_path / "a.pcd", Cloud(points, None, None))
    read = read_cloud(tmp_path / "a.pcd", LIMITS)
    assert ("is the image of no pinhole camera" in read.note) == (share == 1.0)
    sizes_are_known(find(read.frame, LIMITS, COLORS, T_BASE_CAMERA), 3)
