# SPDX-License-Identifier: Apache-2.0
"""Joints that turn without end: angles a whole turn apart are one posture, and the nearest one is meant. rad."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.types import Array


def nearest_turns(q: ArrayLike, near: ArrayLike, upper: ArrayLike) -> Array:
    """Return positions with each joint that turns without end in the turn nearest to another position.

    Args:
        q: (..., n) positions; other joints keep theirs.
        near: (..., n) positions.
        upper: (n,) upper limits, infinite for a joint that turns without end.
    """
    values, endless = np.asarray(q, dtype=np.float64), np.isinf(upper)
    if not endless.any():
        return values
    return values + math.tau * np.where(endless, np.round(np.subtract(near, values) / math.tau), 0.0)


def other_ways(q: Array, near: Array, upper: Array) -> Array:
    """Return each position once for each joint that turns without end, with that joint the other way round.

    Args:
        q: (k, n) positions in the turns nearest to `near`.
        near: (n,) positions.
        upper: Same as for `nearest_turns`.

    Returns:
        (m k, n) of m such joints: all of the first, then all of the next.
    """
    joints = np.flatnonzero(np.isinf(upper))
    out = np.repeat(q[None], len(joints), axis=0)
    for rows, joint in zip(out, joints, strict=True):
        rows[:, joint] -= np.copysign(math.tau, q[:, joint] - near[joint])
    return out.reshape(-1, q.shape[1])
