# SPDX-License-Identifier: Apache-2.0
"""Noise of depth against the published model of a stereo camera, and of colour."""

from __future__ import annotations

import math

import numpy as np
import pytest

from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig, add_colour_noise, add_depth_noise

FOCAL = 240 / math.tan(math.radians(30))
D435 = DepthNoiseConfig(enabled=True)


def plane(z: float) -> np.ndarray:
    return np.full((480, 640), z, np.float32)


@pytest.mark.parametrize("z", [0.3, 0.5, 1.0, 2.0])
@pytest.mark.requirement("A-52")
def test_the_error_grows_with_the_square_of_the_distance(z: float) -> None:
    noisy = add_depth_noise(plane(z), FOCAL, D435, np.random.default_rng(0))
    rms = np.nanstd(noisy)
    # RMS of the matcher and, independent of it, of rounding to steps.
    published = z * z * math.hypot(D435.subpixel, D435.step / math.sqrt(12)) / (FOCAL * D435.baseline)
    assert rms == pytest.approx(published, rel=0.05)
    assert np.nanmean(noisy) == pytest.approx(z, abs=0.2 * published + 1e-4)
    assert np.isnan(noisy).mean() == pytest.approx(D435.dropout, rel=0.2)


@pytest.mark.requirement("A-52")
def test_disparity_comes_in_steps() -> None:
    noisy = add_depth_noise(plane(1.0), FOCAL, D435, np.random.default_rng(0))
    steps = FOCAL * D435.baseline / noisy[np.isfinite(noisy)] / D435.step
    np.testing.assert_allclose(steps, np.round(steps), atol=0.01)
    clean = D435.model_copy(update={"subpixel": 0.0, "step": 0.0, "dropout": 0.0})
    np.testing.assert_allclose(add_depth_noise(plane(1.0), FOCAL, clean, np.random.default_rng(0)), 1.0, atol=1e-6)


@pytest.mark.requirement("A-52")
def test_edges_fly_and_drop_out_and_planes_do_not() -> None:
    z = plane(1.0)
    z[:, 320:] = 0.6
    config = D435.model_copy(update={"subpixel": 0.0, "step": 0.0, "dropout": 0.0})
    noisy = add_depth_noise(z, FOCAL, config, np.random.default_rng(0))
    edge = noisy[:, 319:321]
    between = (edge > 0.605) & (edge < 0.995)
    assert between.mean() == pytest.approx(config.flying, abs=0.04)
    assert np.isnan(edge).mean() == pytest.approx(config.edge_dropout, abs=0.04)
    np.testing.assert_allclose(np.delete(noisy, [319, 320], axis=1), np.delete(z, [319, 320], axis=1), atol=1e-6)


def test_what_is_invalid_stays_invalid_and_a_seed_repeats() -> None:
    z = plane(1.0)
    z[:100] = np.nan
    noisy = [add_depth_noise(z, FOCAL, D435, np.random.default_rng(7)) for _ in range(2)]
    assert np.isnan(noisy[0][:100]).all()
    np.testing.assert_array_equal(noisy[0], noisy[1])


def test_colour_noise_and_exposure() -> None:
    pixels = np.full((240, 320, 3), 100, np.uint8)
    add_colour_noise(pixels, ColourNoiseConfig(), np.random.default_rng(0))
    assert (pixels == 100).all()
    add_colour_noise(pixels, ColourNoiseConfig(sigma=8.0, exposure=1.5), np.random.default_rng(0))
    assert pixels.mean() == pytest.approx(150, abs=0.5)
    assert pixels.std() == pytest.approx(8.0, rel=0.05)
    add_colour_noise(pixels, ColourNoiseConfig(exposure=8.0), np.random.default_rng(0))
    assert (pixels == 255).all()
