# SPDX-License-Identifier: Apache-2.0
"""Appearance of training pictures: shapes and sensor effects; lamps, colours and tables are those of scenes.

Lengths in m in the object's frame: origin in its middle, z along the axis of a cylinder.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common import se3
from openarm_common.types import Array

Rng = np.random.Generator

#: Share of cylinders that lie on their side.
LYING = 0.12


def draw_shape(rng: Rng, kind: str) -> tuple[Array, Array]:
    """Half extents (3,) along the object's axes, m, and its attitude (3, 3)."""
    R = se3.rot_z(rng.uniform(-math.pi, math.pi))[:3, :3]
    if kind == "sphere":
        return np.full(3, rng.uniform(0.018, 0.038)), R
    a, b = rng.uniform(0.016, 0.038, 2)
    if kind == "box" and rng.random() < 0.5:
        return np.full(3, a), R
    if kind == "box":
        return np.array([a, b, rng.uniform(0.016, min(0.058, 2.2 * min(a, b)))]), R
    if rng.random() < 0.3:
        a, height = rng.uniform(0.030, 0.035), rng.uniform(0.052, 0.060)  # drink cans
    else:
        height = rng.uniform(0.016, min(0.058, 2.2 * a))
    if rng.random() < LYING:
        R = R @ se3.rot_x(math.pi / 2.0)[:3, :3]
    return np.array([a, a, height]), R


def surface(kind: str, half: Array) -> Array:
    """Points (n, 3) of the surface in the object's frame whose convex hull is the object, m."""
    if kind == "box":
        signs = np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return signs * half
    turn = np.arange(32) * (math.tau / 32)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    if kind == "cylinder":
        return np.concatenate([np.c_[ring * half[0], np.full(32, z)] for z in (-half[2], half[2])])
    tilt = np.linspace(-math.pi / 2.0, math.pi / 2.0, 17)
    return np.concatenate([np.c_[ring * math.cos(t), np.full(32, math.sin(t))] for t in tilt]) * half[0]


def sensor(rng: Rng, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A little blur and noise on half of the pictures, as of a real colour camera."""
    if rng.random() < 0.5:
        return rgb
    out = cv2.GaussianBlur(rgb, (0, 0), float(rng.uniform(0.3, 1.0))).astype(np.float32)
    out += rng.normal(0.0, float(rng.uniform(1.0, 7.0)), out.shape).astype(np.float32)
    return np.clip(out, 0, 255).astype(np.uint8)
