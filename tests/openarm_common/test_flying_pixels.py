# SPDX-License-Identifier: Apache-2.0
"""Pixels between surfaces are found; surfaces, however slanted or thin, are left alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from openarm_common.camera.cameras import Intrinsics
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.flying_pixels import NOTHING_KNOWN, FlyingConfig, label_flying
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise

K = Intrinsics.from_fovy(640, 480, 60.0)
NEAR, FAR = 0.2, 3.0


def flying(depth: np.ndarray, intrinsics: Intrinsics = K, **config: float) -> np.ndarray:
    """Mask of the pixels that are labelled; their number is the one that is returned."""
    label = np.zeros(depth.shape, np.uint8)
    view = DepthView(depth, intrinsics, np.eye(4), NEAR, FAR)
    count = label_flying(view, FlyingConfig(**config), label)
    found = label == NOTHING_KNOWN
    assert set(np.unique(label)) <= {0, NOTHING_KNOWN}
    assert count == found.sum()
    return found


def d435(z: np.ndarray, seed: int = 0) -> np.ndarray:
    """What a D435 would measure, mm."""
    noisy = add_depth_noise(z.astype(np.float32), K.fy, DepthNoiseConfig(), np.random.default_rng(seed))
    return np.nan_to_num(np.round(noisy * 1e3)).astype(np.uint16)


@settings(max_examples=50)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(1, 8), st.integers(1, 12), st.integers(1, 9))
def test_it_does_what_it_says(seed: int, metres: bool, neighbours: int, width: int, height: int) -> None:
    """Any image of any size, holes, values that are not numbers and borders included: as computed pixel by pixel."""
    rng = np.random.default_rng(seed)
    depth = rng.choice(np.array([0, 150, 980, 995, 1000, 1012, 1030, 5000], np.uint16), (height, width))
    if metres:
        depth = (depth * 1e-3).astype(np.float32)
        depth[depth == 0] = rng.choice(np.array([np.nan, np.inf, 0.0, -1.0], np.float32))
    k = Intrinsics.from_fovy(width, 480, 60.0)
    k = Intrinsics(width, height, k.fx, k.fy, k.cx, k.cy)
    z = np.pad(depth * (1.0 if metres else 1e-3), 1)
    expected = np.zeros(depth.shape, bool)
    for v in range(height):
        for u in range(width):
            here = z[v + 1, u + 1]
            if NEAR <= here <= FAR:
                limit = (math.tan(math.radians(75.0)) / k.fx + 0.006 * here) * here
                same = np.abs(z[v : v + 3, u : u + 3] - here) < limit
                expected[v, u] = same.sum() - 1 < neighbours
    np.testing.assert_array_equal(flying(depth, k, neighbours=neighbours), expected)


def test_labels_that_are_there_stay() -> None:
    """The robot's pixels keep their label, and what has no depth gets none."""
    depth = np.full((480, 640), 1000, np.uint16)
    depth[100, 100], depth[100, 200], depth[100, 300] = 700, 700, 0
    label = np.zeros(depth.shape, np.uint8)
    label[100, 200] = 1
    assert label_flying(DepthView(depth, K, np.eye(4), NEAR, FAR), FlyingConfig(), label) == 5  # one, and four corners
    assert (label[100, 100], label[100, 200], label[100, 300]) == (NOTHING_KNOWN, 1, 0)


@pytest.mark.parametrize("slant", [0.0, 45.0, 60.0, 74.0])
def test_planes_up_to_the_slant_are_left_alone(slant: float) -> None:
    """Without noise each pixel inside of the image is kept, steps of a millimetre or not."""
    _, y = np.meshgrid((np.arange(640) - K.cx) / K.fx, (np.arange(480) - K.cy) / K.fy)
    tan = math.tan(math.radians(slant))
    z = 0.9 / (1.0 - y * tan)
    z[(z < NEAR) | (z > 1.5)] = 0.0
    inside = np.s_[1:-1, 1:-1]
    for depth in (z.astype(np.float32), np.round(z * 1e3).astype(np.uint16)):
        whole = np.ones(depth.shape, bool)
        for dv in (-1, 0, 1):  # rows next to a row without depth have too few neighbours
            whole &= np.roll(depth, dv, axis=0) > 0
        assert whole[inside].sum() > 2000
        assert not (flying(depth) & whole)[inside].any()


@pytest.mark.parametrize("gap", [0.15, 1.0])
@pytest.mark.requirement("A-51", "A-52")
def test_what_floats_between_two_surfaces_is_found(gap: float) -> None:
    """A disc before a wall, as a D435 sees it: what is left lies at the disc or at the wall."""
    v, u = np.mgrid[:480, :640]
    clean = np.where(np.hypot(u - 320, v - 240) < 100, 1.4 - gap, 1.4)
    tolerance = 0.04  # at 1.4 m neighbours may differ by 24 mm, and twice the noise is 15 mm
    for seed in range(3):
        measured = d435(clean, seed)
        depth, found = measured * 1e-3, flying(measured)
        between = (depth > 1.4 - gap + tolerance) & (depth < 1.4 - tolerance)
        assert between.sum() > 50
        assert (between & ~found).sum() <= 0.01 * between.sum()
        surface = (depth > 0) & ~between
        assert (surface & found).mean() < 0.004


def test_thin_things_stay() -> None:
    """A rod of two pixels in a clean image; under noise one of four keeps a pixel in every cell of 2 cm."""
    clean = np.full((480, 640), 1.5)
    clean[:, 300:302] = 1.0
    assert not flying(clean.astype(np.float32))[1:-1, 299:303].any()
    clean[:, 300:304] = 1.0
    depth = d435(clean)
    kept = (np.abs(depth[:, 300:304] * 1e-3 - 1.0) < 0.02) & ~flying(depth)[:, 300:304]
    pixels = int(0.02 * K.fy)
    rows = np.add.reduceat(kept.sum(axis=1), np.arange(0, 480, pixels))
    assert (rows > 0).all()


def test_a_mistake_in_the_configuration_is_named() -> None:
    with pytest.raises(ValidationError, match="slant_deg"):
        FlyingConfig(slant_deg=90.0)
    with pytest.raises(ValidationError, match="neighbours"):
        FlyingConfig(neighbours=9)
