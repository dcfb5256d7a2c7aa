# SPDX-License-Identifier: Apache-2.0
"""Whatever a camera sends: points, a named refusal, never anything else."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import load_config
from openarm_common.errors import Code
from openarm_common.resources import config_dir
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.geometry.depth import Deprojector, DepthLimits, View
from openarm_perception.geometry.filters import CloudFilter, FilterConfig
from openarm_perception.geometry.table import measure_table
from tests.refusals import refused

LIMITS = DepthLimits(near=0.07, far=2.0)
DETECTOR = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))

SHAPES = st.tuples(st.integers(1, 40), st.integers(1, 40))
METRES = SHAPES.flatmap(
    lambda shape: hnp.arrays(
        np.float32, shape, elements=st.floats(width=32) | st.sampled_from([0.0, np.nan, np.inf, -np.inf, -1.0, 0.5])
    )
)
MILLIMETRES = SHAPES.flatmap(lambda shape: hnp.arrays(np.uint16, shape))


@settings(max_examples=50)
@given(METRES | MILLIMETRES, st.integers(0, 1), st.integers(0, 1), st.sampled_from([0, 3, 5]))
@pytest.mark.requirement("B-28", "B-30")
def test_any_depth_image_gives_points_in_range_or_a_named_refusal(depth, dw: int, dh: int, median: int) -> None:
    """NaN, infinite, negative, all zero, 1 x 1, another size than its CameraInfo; with and without filters."""
    height, width = depth.shape
    k = Intrinsics.from_fovy(width + dw, height + dh, 60.0)
    filters = CloudFilter(FilterConfig(median=median, flying=0.03, voxel=0.01, outliers=True))
    pixels = filters.depth(depth)
    if dw or dh:
        assert refused(None, Deprojector(LIMITS).valid_points, pixels, k).code is Code.BAD_IMAGE
        return
    points = filters.points(Deprojector(LIMITS).valid_points(pixels, k))
    assert np.isfinite(points).all()
    assert ((points[:, 2] >= 0.069) & (points[:, 2] <= 2.001)).all()


@settings(max_examples=40)
@given(st.data())
@pytest.mark.requirement("B-28")
def test_any_pair_of_images_gives_finite_objects_or_named_refusals(data) -> None:
    """A red patch anywhere on noise, any depth below it, any pose of the camera."""
    seed = data.draw(st.integers(0, 2**32 - 1))
    rng = np.random.default_rng(seed)
    rgb = np.full((48, 64, 3), 170, np.uint8)
    v, u, size = rng.integers(0, 40), rng.integers(0, 50), rng.integers(5, 40)
    rgb[v : v + size, u : u + size] = (205, 25, 25)
    kind = data.draw(st.sampled_from(["noise", "flat", "nan", "zero", "infinite", "mm"]))
    depth = {
        "noise": rng.uniform(-1.0, 3.0, (48, 64)).astype(np.float32),
        "flat": np.full((48, 64), 0.5, np.float32),
        "nan": np.full((48, 64), np.nan, np.float32),
        "zero": np.zeros((48, 64), np.uint16),
        "infinite": np.full((48, 64), np.inf, np.float32),
        "mm": rng.integers(0, 65536, (48, 64)).astype(np.uint16),
    }[kind]
    T = se3.make(se3.exp_so3(rng.normal(size=3)), rng.normal(size=3))
    config = LocalizerConfig(heights=("red=0.05",) if data.draw(st.booleans()) else ())
    perceived = Pipeline(DETECTOR, Localizer(config, LIMITS, 0.4)).run(
        rgb, depth, Intrinsics.from_fovy(64, 48, 60.0), T
    )
    assert len(perceived.located) + len(perceived.refused) == len(perceived.found)
    assert all(text.strip() for text in perceived.refused)
    for place in perceived.located:
        assert np.isfinite(place.T_base_object).all()
        assert np.isfinite(place.covariance).all()
        assert all(0.0 < edge < 1000.0 for edge in place.size[:2])


@settings(max_examples=15)
@given(st.integers(0, 2**32 - 1), st.floats(-0.06, 0.06), st.floats(0.0, 0.05))
@pytest.mark.requirement("B-63")
def test_the_table_is_measured_to_two_millimetres_with_things_on_it_or_refused(
    seed: int, off: float, tilt: float
) -> None:
    """Expected up to 6 cm wrong, tilted up to 3 degrees, a third of the picture hidden, 2 mm of noise."""
    rng = np.random.default_rng(seed)
    k = Intrinsics.from_fovy(160, 120, 60.0)
    T = se3.make(se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0)), (0.0, 0.0, 1.0))
    rays = k.deproject(np.stack(np.meshgrid(np.arange(160), np.arange(120)), axis=-1), np.ones((120, 160)))
    normal = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    directions = rays @ T[:3, :3].T
    z = (normal @ (np.array([0.0, 0.0, 0.4]) - T[:3, 3])) / (directions @ normal)
    depth = (z + rng.normal(0.0, 0.002, z.shape)).astype(np.float32)
    depth[:40] = rng.uniform(0.3, 0.55, (40, 160))
    depth[rng.random(depth.shape) < 0.05] = np.nan

    def view(depth: NDArray[np.uint16 | np.float32]) -> View:
        return View(np.zeros((120, 160, 3), np.uint8), depth, k, T)

    found = measure_table(view(depth), LIMITS, 0.4 + off)
    seen = np.isfinite(depth[40:])
    middle = (T[:3, 3] + directions[40:][seen] * z[40:][seen][:, None]).mean(axis=0)
    assert abs(found.height - middle[2]) < 0.002 + 0.1 * np.sin(tilt)
    assert abs(found.tilt - tilt) < 0.01
    refused("0 points of a level surface", measure_table, view(np.zeros((120, 160), np.uint16)), LIMITS, 0.4)
