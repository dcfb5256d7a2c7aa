# SPDX-License-Identifier: Apache-2.0
"""How strongly the error of a servo's joint may be corrected by its target, at a latency.

The joint is a mass on the servo's spring and damper, J s² + d s + k, and its target takes effect late. The open loop of
a correction C(s) is C(s) k exp(-s T) / (J s² + d s + k); its greatest sensitivity, max |1 / (1 + L)|, says how far it
is from swinging: 1 is none, below 2 is safe (Åström and Hägglund, Advanced PID Control, 2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from openarm_common.types import Array

#: Greatest sensitivity with the proportional part alone, and with the integral part.
_SENSITIVITY, _WITH_INTEGRAL = 1.8, 2.0
#: Time constant of the derivative part, s: more helps little at some ms of latency, and swings at some tens.
_DERIVATIVE_S = 0.02
_MOST_PROPORTIONAL, _MOST_INTEGRAL = 8.0, 80.0
_STEPS = 12
_OMEGA = np.geomspace(0.5, 300.0, 400)


@dataclass(frozen=True, eq=False)
class LoopGains:
    """Gains (k,) from the error of joints to the shift of their targets: rad a rad, a rad/s, a rad s."""

    proportional: Array
    derivative: Array
    integral: Array


def safe_gains(stiffness: Array, damping: Array, inertia: Array, delay_s: Array) -> LoopGains:
    """Return the largest gains that are safe for every inertia.

    Args:
        stiffness: (k,) of the servos, N m/rad.
        damping: (k,) with that of the gearbox, N m s/rad.
        inertia: (n, k) that occur, kg m2.
        delay_s: (k,) from a measurement to the effect of the target.
    """
    s = 1j * _OMEGA
    found: list[tuple[float, float, float]] = []
    for k, d, masses, delay in zip(stiffness.tolist(), damping.tolist(), inertia.T, delay_s.tolist(), strict=True):
        plant = k * np.exp(-s * delay) / (masses[:, None] * s**2 + d * s + k)

        def sensitivity(p: float, i: float, plant: Array = plant) -> float:
            returned = 1.0 + (p + _DERIVATIVE_S * s + i / s) * plant
            turns = np.ptp(np.unwrap(np.angle(returned)), axis=1)
            return float(np.max(1.0 / np.abs(returned))) if np.all(turns < 1.01 * np.pi) else np.inf

        p = _largest(lambda x: sensitivity(x, 0.0) < _SENSITIVITY, _MOST_PROPORTIONAL)
        i = _largest(lambda x, p=p: sensitivity(p, x) < _WITH_INTEGRAL, _MOST_INTEGRAL) if p else 0.0
        found.append((p, _DERIVATIVE_S if p else 0.0, i))
    return LoopGains(*np.array(found).T)


def _largest(safe: Callable[[float], bool], most: float) -> float:
    """Return the largest value that is safe, where smaller ones are, to a part in 4096; 0 when none is."""
    low, high = 0.0, most
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if safe(middle) else (low, middle)
    return low
