# SPDX-License-Identifier: Apache-2.0
"""Motions that show the dynamics of servos: joints go to and fro, at speeds of their own, around some postures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.servos import ArmLoad
from openarm_common.types import Array

#: How far each joint goes from the posture, rad.
AMPLITUDE = 0.12
#: Shortest and longest period of a joint, s, and periods of the one that is fastest.
_PERIODS, _CYCLES = (0.5, 0.9), 8
#: The second half of a motion is smaller and slower by this, so that damping and dry friction differ.
_SLOW = 0.4
_CORNERS = 12


def waves(posture: Array) -> tuple[Array, Array]:
    """Return times (n,) and positions (n, k) of a motion of straight pieces that begins and ends in a posture (k,)."""
    k = len(posture)
    duration = _CYCLES * _PERIODS[0]  # of either half
    cycles = np.array([max(1, round(duration / period)) for period in np.linspace(*_PERIODS, k)])
    # joints of equal count begin at different moments, so that no two move alike
    delays = np.linspace(0.0, 0.5, k)
    quarters = [delays[j] + np.arange(8 * cycles[j] + 1) * duration / (4 * cycles[j]) for j in range(k)]
    vertices: Array = np.concatenate([[0.0], *quarters, [2.0 * duration + 1.0]])
    t = np.unique(vertices.round(6))
    q = np.tile(posture, (len(t), 1))
    for j, at in enumerate(quarters):
        height = np.array([(0.0, 1.0, 0.0, -1.0)[i % 4] for i in range(len(at))])
        height[4 * cycles[j] :] *= _SLOW
        q[:, j] += AMPLITUDE * np.interp(t, at, height)
    return t, q


def postures(
    lower: Array, upper: Array, load: ArmLoad, free: Callable[[Array], bool], count: int, rng: np.random.Generator
) -> list[Array]:
    """Choose postures (k,) in which joints carry weights that differ as much as possible.

    Args:
        lower: (k,) limits of the joints.
        upper: The same.
        load: Torques of the arm.
        free: Whether a configuration is free of collisions.
        count: Number of postures.
        rng: Draws what is tried.

    Raises:
        OpenArmError: NO_PLAN, when hardly any posture is free.
    """
    room = AMPLITUDE + 0.05
    tried: list[Array] = []
    for _ in range(200 * count):
        q = rng.uniform(lower + room, upper - room)
        corners = q + AMPLITUDE * rng.choice((-1.0, 1.0), (_CORNERS, len(q)))
        if free(q) and all(map(free, corners)):
            tried.append(q)
            if len(tried) == 8 * count:
                break
    if len(tried) < count:
        raise OpenArmError(
            Code.NO_PLAN, f"{len(tried)} postures are free, expected {count}: clear the space of the arm"
        )
    still = np.zeros_like(lower)
    torques = np.array([load.torque(q, still, still) for q in tried])
    torques /= np.ptp(torques, axis=0) + 1e-9
    chosen = [int(np.argmax(np.sum(torques**2, axis=1)))]
    while len(chosen) < count:
        apart = np.min([np.abs(torques - torques[i]).sum(axis=1) for i in chosen], axis=0)
        chosen.append(int(np.argmax(apart)))
    return [tried[i] for i in chosen]
