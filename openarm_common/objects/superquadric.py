# SPDX-License-Identifier: Apache-2.0
"""Superquadrics without number: boxes, cylinders, pillows, spindles and what is between them, from a seed.

A. H. Barr, "Superquadrics and angle-preserving transformations", IEEE CG&A 1(1), 1981: |x/a|^(2/e2) + |y/b|^(2/e2)
to the power e2/e1, plus |z/c|^(2/e1), is at most 1. Exponents up to 2 are convex.
"""

from __future__ import annotations

import colorsys
import math
from dataclasses import dataclass

import numpy as np
from scipy.special import beta

from openarm_common.types import Array

#: Rings from pole to pole and points of a ring.
_RINGS, _ROUND = 24, 48


@dataclass(frozen=True)
class Superquadric:
    """One convex shape.

    Attributes:
        half: Half extents along x, y, z, m.
        e1: Exponent from pole to pole, 0.1 (square) over 1 (round) to 2 (pointed).
        e2: Exponent around, the same.
        taper: Share by which x and y shrink towards +z and grow towards -z, -0.5 to 0.5.
    """

    half: tuple[float, float, float]
    e1: float
    e2: float
    taper: float = 0.0

    @property
    def volume(self) -> float:
        """In closed form, m3; with a taper, of the tapered shape itself, which is convex for e1 up to 1.

        A. Jaklič, A. Leonardis, F. Solina, "Segmentation and Recovery of Superquadrics", 2000, section 2.4; the second
        term is the integral of the section's area times (taper z/c)².
        """
        a, b, c = self.half
        e1, e2 = self.e1, self.e2
        section = 2.0 * a * b * e2 * beta(e2 / 2.0, e2 / 2.0 + 1.0)
        mean = beta(e1 / 2.0, e1 + 1.0) + self.taper**2 * beta(1.5 * e1, e1 + 1.0)
        return float(section * c * e1 * mean)

    def points(self, rings: int = _RINGS, around: int = _ROUND) -> Array:
        """Return points (n, 3) of the surface, m."""
        up = np.linspace(-math.pi / 2.0, math.pi / 2.0, rings + 1)
        turn = np.arange(around) * (math.tau / around)
        U, W = np.meshgrid(up, turn, indexing="ij")
        x = _power(np.cos(U), self.e1) * _power(np.cos(W), self.e2)
        y = _power(np.cos(U), self.e1) * _power(np.sin(W), self.e2)
        z = _power(np.sin(U), self.e1)
        narrow = 1.0 - self.taper * z
        return np.stack([x * narrow, y * narrow, z], axis=-1).reshape(-1, 3) * np.array(self.half)


def _power(values: Array, exponent: float) -> Array:
    """Power of the amount, with the sign."""
    values = np.where(np.abs(values) < 1e-12, 0.0, values)
    return np.sign(values) * np.abs(values) ** exponent


def draw_superquadric(seed: int) -> tuple[Superquadric, tuple[float, float, float]]:
    """Draw a shape and its colour: edges of 30 to 110 mm, the narrowest up to 66 mm; same seed, same shape.

    Args:
        seed: 0 or more.
    """
    rng = np.random.default_rng([seed, 4711])
    edges = [rng.uniform(0.030, 0.066), *rng.uniform(0.035, 0.110, 2)]
    half = tuple(0.5 * round(float(edge), 4) for edge in rng.permutation(edges))
    e1, e2 = (round(float(value), 3) for value in rng.uniform(0.1, 1.6, 2))
    taper = round(float(rng.uniform(-0.35, 0.35)), 3) if rng.random() < 0.4 else 0.0
    color = colorsys.hsv_to_rgb(rng.random(), rng.uniform(0.05, 0.9), rng.uniform(0.25, 0.9))
    return Superquadric((half[0], half[1], half[2]), e1, e2, taper), color
