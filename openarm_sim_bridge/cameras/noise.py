# SPDX-License-Identifier: Apache-2.0
"""Noise of real cameras: of depth as of an active stereo camera, and of colour.

The depth of a stereo camera is focal length × baseline / disparity. Its matcher finds the disparity with an error of
`subpixel` and in steps of `step` pixels, so the error of depth grows with its square: z² × subpixel / (f × baseline),
the figure that makers give as depth RMS. At jumps of depth a pixel may show a mixture of both sides, or nothing.
Depth is planar, m, NaN where invalid.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from openarm_common.config import Config
from openarm_common.types import Bytes, Floats, Mask


class DepthNoiseConfig(Config):
    """Noise of depth images; the defaults are those of a D435."""

    enabled: bool = Field(default=False, description="whether depth is noisy")
    baseline: float = Field(default=0.05, gt=0.0, le=1.0, description="between the two imagers, m")
    subpixel: float = Field(default=0.08, ge=0.0, le=2.0, description="rms error of the disparity, pixels")
    step: float = Field(default=0.03125, ge=0.0, le=1.0, description="steps of the disparity, pixels; 0: none")
    jump: float = Field(default=0.02, gt=0.0, le=1.0, description="a difference of neighbours above this is an edge, m")
    flying: float = Field(default=0.3, ge=0.0, le=1.0, description="share of edge pixels that lie between both sides")
    edge_dropout: float = Field(default=0.2, ge=0.0, le=1.0, description="share of edge pixels without depth")
    dropout: float = Field(default=0.002, ge=0.0, le=1.0, description="share of all pixels without depth")


class ColourNoiseConfig(Config):
    """Noise and exposure of colour images."""

    sigma: float = Field(default=0.0, ge=0.0, le=100.0, description="rms noise, of 255")
    exposure: float = Field(default=1.0, gt=0.0, le=8.0, description="factor of all values; above 255 they clip")


def add_depth_noise(z: Floats, focal: float, config: DepthNoiseConfig, rng: np.random.Generator) -> Floats:
    """Return the depth (height, width) that a camera of this focal length (pixels) would measure.

    Args:
        z: (height, width) true depth, m, NaN where invalid.
        focal: Focal length, pixels.
        config: Parameters of the noise.
        rng: Source of the noise.
    """
    edge, low, high = _edges(z, config.jump)
    out = z.copy()
    chance = rng.random(z.shape, dtype=np.float32)
    flying = edge & (chance < config.flying)
    out[flying] = low[flying] + rng.random(int(flying.sum()), dtype=np.float32) * (high - low)[flying]
    scale = np.float32(focal * config.baseline)
    disparity = scale / out
    disparity += np.float32(config.subpixel) * rng.standard_normal(z.shape, dtype=np.float32)
    if config.step > 0.0:
        disparity = np.round(disparity / np.float32(config.step)) * np.float32(config.step)
    with np.errstate(divide="ignore"):
        out = scale / disparity
    holes = (edge & (chance > 1.0 - config.edge_dropout)) | (rng.random(z.shape, dtype=np.float32) < config.dropout)
    out[holes | ~(disparity > 0.0)] = np.nan
    return out


def _edges(z: Floats, jump: float) -> tuple[Mask, Floats, Floats]:
    """Return which pixels have a jump to a neighbour, and the nearest and the farthest of those around."""
    padded = np.pad(z, 1, mode="edge")
    near = (padded[1:-1, :-2], padded[1:-1, 2:], padded[:-2, 1:-1], padded[2:, 1:-1])
    low, high = z, z
    for other in near:
        low, high = np.fmin(low, other), np.fmax(high, other)
    return np.asarray(high - low > np.float32(jump)), low, high


def add_colour_noise(pixels: Bytes, config: ColourNoiseConfig, rng: np.random.Generator) -> None:
    """Make a colour image (height, width, 3) brighter or darker and noisy, in place.

    Args:
        pixels: (height, width, 3), changed.
        config: Parameters of noise and exposure.
        rng: Source of the noise.
    """
    if config.sigma == 0.0 and config.exposure == 1.0:
        return
    values = pixels * np.float32(config.exposure)
    if config.sigma > 0.0:
        values += np.float32(config.sigma) * rng.standard_normal(pixels.shape, dtype=np.float32)
    np.copyto(pixels, np.clip(values + np.float32(0.5), 0, 255).astype(np.uint8))
