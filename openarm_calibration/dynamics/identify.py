# SPDX-License-Identifier: Apache-2.0
"""Gain, damping, friction and latency of position servos, from their targets and joint states.

A servo with the gain k follows its target u, which takes effect L late:

    k (u(t - L) - q) = tau(q, q', q'') + armature q'' + damping q' + friction sign(q')

with the torque tau of the robot's description. Divided by k, this is linear in 1/k, damping/k, friction/k and
armature/k. Both sides are weighted with smooth functions of some 0.15 s and integrated by parts, so that positions
alone are needed and neither noise nor the steps of the targets matter (modulating functions: Shinbrot, 1957; Co and
Ydstie, System identification using modulating functions, Automatica 1990). The latency is the one that fits best.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.records import now
from openarm_common.robot.servo_store import StoredServos
from openarm_common.robot.servos import ArmLoad, ServoModel
from openarm_common.types import Array

#: Half width of the weights, in samples, and fine steps of a sample in which latency and targets are known.
_HALF, _FINE = 8, 10
#: Latencies that are tried, s.
_MOST_LATENCY_S, _LATENCY_STEP_S = 0.06, 0.001
#: Slower than this, dry friction has no direction, rad/s; windows with so many such samples do not count.
_STILL, _MOST_STILL = 0.03, 3
_LEAST_WINDOWS = 100


@dataclass(frozen=True, eq=False)
class ServoLog:
    """Targets and positions of the joints of an arm, one row a period.

    Attributes:
        period_s: Time from a row to the next, s.
        target: (n, k) that were sent at the times of the rows, and kept until the next, rad.
        position: (n, k) measured at those times, rad.
    """

    period_s: float
    target: Array
    position: Array


@dataclass(frozen=True, eq=False)
class Identified:
    """Servos, and standard deviations of what was found of them; `rms` (k,) is what is left of the targets, rad."""

    servos: ServoModel
    stiffness_std: Array
    damping_std: Array
    friction_std: Array
    latency_std: Array
    rms: Array

    def record(self, arm: str, dynamics_seed: int | None) -> StoredServos:
        """Return them as they are stored.

        Args:
            arm: Name of the arm.
            dynamics_seed: Seed of the simulated robot; None: a real one.
        """
        servos = self.servos
        values = {
            "stiffness": servos.stiffness,
            "damping": servos.damping,
            "friction": servos.friction,
            "armature": servos.armature,
            "latency": servos.latency_s,
            "stiffness_std": self.stiffness_std,
            "damping_std": self.damping_std,
            "friction_std": self.friction_std,
            "latency_std": self.latency_std,
            "rms": self.rms,
        }
        rounded = {key: [round(float(value), 6) for value in array] for key, array in values.items()}
        about = {"arm": arm, "dynamics_seed": dynamics_seed, "created": now()}
        return StoredServos.model_validate(rounded | about)


def identify(logs: list[ServoLog], load: ArmLoad) -> Identified:
    """Identify the servos of an arm.

    Args:
        logs: While the arm moved, all joints in both directions, in postures in which they carry different weights.
        load: Torques of the arm by its description.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the motions do not show a joint's dynamics, naming it.
    """
    windows = [_windows(log, load) for log in logs if len(log.position) > 2 * _HALF + _MOST_LATENCY_S / log.period_s]
    k = logs[0].position.shape[1] if logs else 0
    found: list[tuple[float, ...]] = []
    for j in range(k):
        rows = np.concatenate([w.regressors[w.moving[:, j], j] for w in windows])
        left = np.concatenate([w.held[w.moving[:, j], :, j] for w in windows])  # by latency
        if len(rows) < _LEAST_WINDOWS or np.linalg.matrix_rank(rows) < rows.shape[1]:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"joint {j + 1} moved in {len(rows)} windows of {2 * _HALF} samples, expected {_LEAST_WINDOWS} or more,"
                " in both directions and in postures in which it carries different weights",
            )
        found.append(_fit(rows, left))
    values = np.array(found).T
    inverse, lag, slide, armature, latency = values[:5]
    stiffness = 1.0 / inverse
    std = values[5:]
    return Identified(
        ServoModel(stiffness, lag * stiffness, slide * stiffness, armature * stiffness, latency, weight=1.0),
        stiffness_std=std[0] * stiffness**2,
        damping_std=std[1] * stiffness,
        friction_std=std[2] * stiffness,
        latency_std=std[4],
        rms=std[5],
    )


@dataclass(frozen=True, eq=False)
class _Windows:
    regressors: Array  # (n, k, 4): torque, velocity, direction, acceleration
    held: Array  # (n, latencies, k): weighted target minus weighted position
    moving: NDArray[np.bool_]  # (n, k) whether friction has a direction


def _windows(log: ServoLog, load: ArmLoad) -> _Windows:
    T, q = log.period_s, log.position
    x = np.linspace(-1.0, 1.0, 2 * _HALF + 1)
    width = _HALF * T
    weight = (1.0 - x**2) ** 4
    scale = 1.0 / np.sum(weight)
    first = -8.0 * x * (1.0 - x**2) ** 3 / width
    second = (-8.0 * (1.0 - x**2) ** 3 + 48.0 * x**2 * (1.0 - x**2) ** 2) / width**2

    def smooth(values: Array, kernel: Array) -> Array:
        view = np.lib.stride_tricks.sliding_window_view(values, len(kernel), axis=0)
        return view @ (scale * kernel)

    position, velocity, acceleration = smooth(q, weight), -smooth(q, first), smooth(q, second)
    torque = np.array([load.torque(*state) for state in zip(position, velocity, acceleration, strict=True)])
    speed = np.gradient(q, T, axis=0)
    direction = smooth(np.tanh(speed / _STILL), weight)
    still = np.lib.stride_tricks.sliding_window_view(np.abs(speed) < _STILL, 2 * _HALF + 1, axis=0).sum(axis=-1)
    return _Windows(
        regressors=np.stack([torque, velocity, direction, acceleration], axis=-1),
        held=_weighted_targets(log, weight * scale) - position[:, None, :],
        moving=still <= _MOST_STILL,
    )


def _weighted_targets(log: ServoLog, weight: Array) -> Array:
    """Weighted targets (n, latencies, k): each is kept until the next, and takes effect late."""
    n = len(log.position) - 2 * _HALF
    latencies = np.arange(0.0, _MOST_LATENCY_S + 1e-9, _LATENCY_STEP_S)
    out = np.empty((n, len(latencies), log.target.shape[1]))
    at = np.arange(len(log.position))
    fine = (np.arange(_FINE) + 0.5) / _FINE - 0.5  # within the sample around each time
    for i, latency in enumerate(latencies):
        mean = np.zeros_like(log.target)
        for part in fine:
            index = np.floor(at + part - latency / log.period_s + 1e-9).astype(int)
            mean += log.target[np.clip(index, 0, len(at) - 1)] / _FINE
        out[:, i] = np.lib.stride_tricks.sliding_window_view(mean, len(weight), axis=0) @ weight
    return out


def _fit(rows: Array, left: Array) -> tuple[float, ...]:
    """Fit one joint: parameters, latency, their standard deviations, and the rms that is left."""
    solution, _, _, _ = np.linalg.lstsq(rows, left, rcond=None)
    np.maximum(solution[1:], 0.0, out=solution[1:])  # what is small comes out below 0 now and then
    rms = np.sqrt(np.mean((left - rows @ solution) ** 2, axis=0))
    best = int(np.argmin(rms))
    independent = max(1.0, len(rows) / (2 * _HALF))
    covariance = np.linalg.inv(rows.T @ rows) * rms[best] ** 2 * len(rows) / independent
    # where the mean square rises by one part in the number of independent windows
    near = np.flatnonzero(rms**2 <= rms[best] ** 2 * (1.0 + 1.0 / independent))
    spread = max(0.5 * (near[-1] - near[0]), 0.5) * _LATENCY_STEP_S
    std = np.sqrt(np.diag(covariance))
    return (*solution[:, best], best * _LATENCY_STEP_S, *std, spread, float(rms[best]))
