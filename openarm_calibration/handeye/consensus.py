# SPDX-License-Identifier: Apache-2.0
"""Mounts that most pairs of poses agree with: a start for least squares that a wrong pair does not move.

`R_X R_C = R_B R_Z` gives both rotations by the largest singular value of the mean of `R_B ⊗ R_C` (Shah 2013), and
`s R_X t_C + t_X - R_B t_Z = t_B` the translations, and, where the lengths of the board may be in another unit, their
scale `s`. Both are solved again with weights of one over the residual, which is least absolute deviations.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.closed_form import nearest_rotation
from openarm_common import se3
from openarm_common.types import Array

#: Rounds of weights, and those of them that begin again with the closed form.
ROUNDS, _CLOSED = 20, 3
#: Angles about one axis that are tried.
_STEPS = 72
#: Weights end here: residuals as shares of their median.
_LEAST = 1e-3
#: Rotations whose second axis is below this share of the first are about one axis.
_ONE_AXIS = 0.01
#: Of the median of the length of a vector with three normal components, over the deviation of one.
_MEDIAN_OF_THREE = 1.5382


@dataclass(frozen=True, eq=False)
class Consensus:
    """Mounts that most pairs agree with.

    Args:
        X: (4, 4) of the camera, in the robot's unit.
        Z: (4, 4) of the board.
        scale: Factor for lengths in the camera's poses.
        translations: (n,) distance of each board from where the mounts predict it, in the robot's unit.
        rotations: (n,) the same, rad.
        free: (3,) direction along which the camera may be anywhere; zero where the pairs determine it.
    """

    X: Array
    Z: Array
    scale: float
    translations: Array
    rotations: Array
    free: Array

    @property
    def spread(self) -> tuple[float, float]:
        """Deviation of a pair by axis, in the robot's unit and rad: by medians."""
        t, r = (float(np.median(values)) / _MEDIAN_OF_THREE for values in (self.translations, self.rotations))
        return t, r


def agreed(B: Array, C: Array, *, scaled: bool = False, rounds: int = ROUNDS) -> Consensus:
    """Return the mounts that most pairs agree with.

    Args:
        B: (n, 4, 4) from the board's to the camera's carrier.
        C: (n, 4, 4) T_camera_board.
        scaled: Whether lengths in C are in a unit of their own.
        rounds: Number of rounds of weights; a few show whether poses agree at all.
    """
    RB, RC = B[:, :3, :3], C[:, :3, :3]
    shared = _one_axis(RB, RC)
    if shared is None:
        return _agreed(B, C, *_rotations(RB, RC, rounds), scaled, np.zeros(3), rounds)
    start, axis = shared

    def turned(angle: float, rounds: int = 1) -> Consensus:
        RX = start @ se3.exp_so3(axis * angle)
        RZ = nearest_rotation(np.einsum("nji,jk,nkl->il", RB, RX, RC))
        return _agreed(B, C, RX, RZ, scaled, RX @ axis, rounds)

    def left(angle: float) -> float:
        return turned(angle).spread[0]

    # translations determine the rotation about that axis
    first = min(np.linspace(0.0, 2.0 * np.pi, _STEPS, endpoint=False), key=left)
    reach = 2.0 * np.pi / _STEPS
    found: Any = minimize_scalar(left, bounds=(first - reach, first + reach), method="bounded", options={"xatol": 1e-4})
    return turned(float(found.x), rounds)


def _agreed(
    B: Array, C: Array, RX: Array, RZ: Array, scaled: bool, free: Array, rounds: int
) -> Consensus:  # fmt: skip
    """Return the mounts with these rotations."""
    tX, tZ, scale = _translations(B, C, RX, scaled, rounds)
    predicted = np.einsum("ji,njk,kl->nil", RX, B[:, :3, :3], RZ)
    angles = Rotation.from_matrix(np.swapaxes(predicted, 1, 2) @ C[:, :3, :3]).magnitude()
    away = np.linalg.norm(scale * C[:, :3, 3] @ RX.T + tX - B[:, :3, :3] @ tZ - B[:, :3, 3], axis=1)
    return Consensus(se3.make(RX, tX), se3.make(RZ, tZ), scale, away, angles, free)


def _rotations(RB: Array, RC: Array, rounds: int) -> tuple[Array, Array]:
    """Return R_X and R_Z of least absolute angles: a closed form, and then Gauss-Newton steps."""
    weight = np.ones(len(RB))
    RX = RZ = np.eye(3)
    for k in range(rounds):
        if k < _CLOSED:
            M = np.einsum("n,nij,nkl->ikjl", weight, RB, RC).reshape(9, 9)
            RZ = np.linalg.svd(M)[2][0].reshape(3, 3)
            RZ = nearest_rotation(RZ if np.linalg.det(RZ) > 0.0 else -RZ)
            RX = nearest_rotation(np.einsum("n,nij,jk,nlk->il", weight, RB, RZ, RC))
        predicted = np.einsum("ji,njk,kl->nil", RX, RB, RZ)
        off = Rotation.from_matrix(np.swapaxes(RC, 1, 2) @ predicted).as_rotvec()
        angles = np.linalg.norm(off, axis=1)
        weight = 1.0 / np.maximum(angles, max(_LEAST * float(np.median(angles)), 1e-9))
        if k >= _CLOSED - 1:
            columns = np.concatenate([-np.swapaxes(RC, 1, 2), np.tile(np.eye(3), (len(RC), 1, 1))], axis=2)
            root = np.sqrt(weight)[:, None]
            step = np.linalg.lstsq((columns * root[:, :, None]).reshape(-1, 6), -(off * root).ravel(), rcond=1e-9)[0]
            RX, RZ = RX @ se3.exp_so3(step[:3]), RZ @ se3.exp_so3(step[3:])
    return RX, RZ


def _translations(B: Array, C: Array, RX: Array, scaled: bool, rounds: int) -> tuple[Array, Array, float]:
    """Return t_X, t_Z and the scale of least absolute distances."""
    n = len(B)
    turned = C[:, :3, 3] @ RX.T
    columns = np.concatenate([-np.tile(np.eye(3), (n, 1, 1)), B[:, :3, :3]], axis=2)
    right = -B[:, :3, 3] if scaled else turned - B[:, :3, 3]
    if scaled:
        columns = np.concatenate([columns, -turned[:, :, None]], axis=2)
    weight = np.ones(n)
    solved = np.zeros(columns.shape[2])
    size = np.linalg.norm(columns, axis=(0, 1))
    size[size == 0.0] = 1.0
    for _ in range(rounds):
        root = np.sqrt(weight)[:, None]
        A, b = (columns / size * root[:, :, None]).reshape(3 * n, -1), (right * root).ravel()
        solved = np.linalg.lstsq(A, b, rcond=1e-9)[0] / size
        away = np.linalg.norm(columns @ solved - right, axis=1)
        weight = 1.0 / np.maximum(away, max(_LEAST * float(np.median(away)), 1e-12))
    return solved[:3], solved[3:6], float(solved[6]) if scaled else 1.0


def _one_axis(RB: Array, RC: Array) -> tuple[Array, Array] | None:
    """Return a rotation that maps the one axis of all rotations in C to that in B, and the former; None if two turn."""
    of_B, of_C = (
        Rotation.from_matrix(np.vstack([R[1:] @ R[0].T, R[1:] @ np.swapaxes(R[:-1], 1, 2)])).as_rotvec()
        for R in (RB, RC)
    )
    values, axes = np.linalg.eigh(of_B.T @ of_B)
    if values[1] > _ONE_AXIS**2 * values[2]:
        return None
    to, of = axes[:, 2], np.linalg.eigh(of_C.T @ of_C)[1][:, 2]
    if (of_B @ to) @ (of_C @ of) < 0.0:
        of = -of
    return Rotation.align_vectors(to[None], of[None])[0].as_matrix(), of
