# SPDX-License-Identifier: Apache-2.0
"""Transforms in batches (..., 4, 4), and their change by six numbers: `(p, R) → (p + d, R exp(w))`; m, rad."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from openarm_common import se3
from openarm_common.types import Array


def inverses(T: Array) -> Array:
    """Return the inverse of transforms."""
    return np.linalg.inv(T).astype(np.float64)


def exps(w: Array) -> Array:
    """Return rotations (n, 3, 3) of rotation vectors (n, 3)."""
    return Rotation.from_rotvec(w).as_matrix()


def skews(v: Array) -> Array:
    """Return cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def moved(T: Array, change: Array) -> Array:
    """Return transforms (..., 4, 4) changed by six numbers (..., 6) each: `(p + d, R exp(w))`."""
    out = T.copy()
    out[..., :3, :3] = T[..., :3, :3] @ exps(change[..., 3:])
    out[..., :3, 3] = T[..., :3, 3] + change[..., :3]
    return out


def difference(T_from: Array, T_to: Array) -> Array:
    """Return the six numbers (6,) that change `T_from` into `T_to`."""
    w = se3.log_so3(T_from[:3, :3].T @ T_to[:3, :3])
    return np.concatenate([T_to[:3, 3] - T_from[:3, 3], w])
