# SPDX-License-Identifier: Apache-2.0
"""Mistakes in the robot's poses, undone: what the poses would be if the set had been written down wrongly.

Each variant is a guess at one mistake; `causes` solves it and compares. Units and conventions can't be read off one
pose. Where a variant leaves a choice (angles are known up to whole turns, an order up to a permutation), the one is
taken whose angles between poses are those that the camera saw. m, rad.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.marks import Indices
from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.transforms import inverses
from openarm_common.types import Array

_DEGREES = 180.0 / math.pi
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
#: Angles of poses that agree with the camera's to this are in the same order, rad.
_SAME_ORDER = math.radians(3.0)


@dataclass(frozen=True, eq=False)
class Variant:
    """Poses without one mistake.

    Args:
        name: Name of the mistake.
        text: The mistake in a sentence.
        A: (n, 4, 4) poses without it.
    """

    name: str
    text: str
    A: Array


def variants(problem: Problem) -> Iterator[Variant]:
    """Return what the poses of a problem may have been meant to be.

    Args:
        problem: Its views are of one camera and one board.
    """
    A = problem.A
    yield Variant(
        "set-up",
        "the poses fit the other way round: either the camera is on the arm and the set is given as a fixed camera (or"
        " the reverse), or the poses are inverted (T_tip_base for T_base_tip)",
        inverses(A),
    )
    for factor, text in (
        (1e-3, "the positions of the robot are in millimetres where metres are expected"),
        (1e3, "the positions of the robot are a thousand times too small, or the board's points are in millimetres"),
    ):
        yield Variant("millimetres", text, _with_positions(A, A[:, :3, 3] * factor))
    yield Variant(
        "mirrored poses", "the poses are mirrored, as from a left-handed frame or with the sign of one axis wrong",
        _MIRROR @ A @ _MIRROR,
    )  # fmt: skip
    yield Variant(
        "transposed rotations", "the rotations are transposed, or their quaternions conjugated",
        _with_rotations(A, A[:, :3, :3].swapaxes(1, 2)),
    )  # fmt: skip
    quaternions = Rotation.from_matrix(A[:, :3, :3]).as_quat()
    for shift in (1, -1):
        turned = Rotation.from_quat(np.roll(quaternions, shift, axis=1)).as_matrix()
        yield Variant(
            "order of quaternions", "the quaternions are in the other order (w first for w last)",
            _with_rotations(A, turned),
        )  # fmt: skip
    yield from _degrees(problem)
    order = _order(problem)
    if order is not None:
        yield Variant(
            "swapped poses", "the poses belong to other images: they are in another order than the images", A[order]
        )


def _with_positions(A: Array, t: Array) -> Array:
    out = A.copy()
    out[:, :3, 3] = t
    return out


def _with_rotations(A: Array, R: Array) -> Array:
    out = A.copy()
    out[:, :3, :3] = R
    return out


def _degrees(problem: Problem) -> Iterator[Variant]:
    A = problem.A
    low = "the rotations are too small by the factor between degrees and radians: radians were read as degrees"
    high = "the rotations are in degrees where radians are expected"
    arms = [view.arm for view in problem.views if view.arm is not None]
    if len(arms) == len(problem):
        zeros = np.zeros(problem.joints)
        for factor, text in ((_DEGREES, low), (1.0 / _DEGREES, high)):
            yield Variant(
                "degrees", text.replace("rotations", "joint positions"),
                np.array([arm.scaled(factor).at(zeros)[0] for arm in arms]),
            )  # fmt: skip
        return
    rotations = Rotation.from_matrix(A[:, :3, :3])
    yield Variant(
        "degrees", low, _with_rotations(A, Rotation.from_rotvec(rotations.as_rotvec() * _DEGREES).as_matrix())
    )
    for axes in ("xyz", "XYZ"):
        angles = rotations.as_euler(axes) * _DEGREES
        if np.abs(angles).max() < 4.0 * math.pi:
            yield Variant("degrees", low, _with_rotations(A, Rotation.from_euler(axes, angles).as_matrix()))
    yield Variant("degrees", high, _with_rotations(A, _unwound(problem)))


def angles_between(R: Array) -> Array:
    """Return the angles (n, n) between rotations (n, 3, 3)."""
    cosine = (np.einsum("aij,bij->ab", R, R) - 1.0) / 2.0
    return np.arccos(np.clip(cosine, -1.0, 1.0))


def _unwound(problem: Problem) -> Array:
    """Return the rotations (n, 3, 3) whose rotation vectors in degrees, read in radians, are those of the poses.

    A rotation of `w` degrees read as radians turns by `w` modulo a whole turn, so that each is one of 57; those are
    taken that agree best with the camera about the angles between poses.
    """
    w = Rotation.from_matrix(problem.A[:, :3, :3]).as_rotvec()
    angle = np.linalg.norm(w, axis=1)
    axis = w / np.maximum(angle, 1e-12)[:, None]
    turns = np.arange(-29, 30)
    candidates = (angle[:, None] + math.tau * turns[None]) / _DEGREES  # (n, k) of either sign, at most half a turn
    inside = np.abs(candidates) <= math.pi * 1.001
    n, k = candidates.shape
    R = Rotation.from_rotvec((candidates[:, :, None] * axis[:, None]).reshape(-1, 3)).as_matrix().reshape(n, k, 9)
    seen = np.cos(angles_between(problem.free[:, :3, :3]))
    best, lowest, cost = np.zeros(n, dtype=np.int64), math.inf, np.zeros((n, k))
    for first in np.flatnonzero(inside[0]):
        against = (R @ R[0, first] - 1.0) / 2.0  # (n, k)
        away = np.where(inside, np.abs(against - seen[0][:, None]), np.inf)
        chosen = np.argmin(away, axis=1)
        chosen[0] = first
        for _ in range(4):
            own = R[np.arange(n), chosen]
            cosine = (np.einsum("nkc,mc->nkm", R, own) - 1.0) / 2.0
            cost = np.where(inside, np.abs(cosine - seen[:, None, :]).sum(axis=2), np.inf)
            again = np.argmin(cost, axis=1)
            if np.array_equal(again, chosen):
                break
            chosen = again
        total = float(cost[np.arange(n), chosen].sum())
        if total < lowest:
            best, lowest = chosen, total
    return R[np.arange(n), best].reshape(n, 3, 3)


def _order(problem: Problem) -> Indices | None:
    """Return which pose (n,) belongs to each view by the angles to all others; None: in order, or unclear."""
    robot, camera = angles_between(problem.A[:, :3, :3]), angles_between(problem.free[:, :3, :3])
    cost = np.abs(np.sort(camera, axis=1)[:, None] - np.sort(robot, axis=1)[None]).mean(axis=2)
    _, order = linear_sum_assignment(cost)
    away = np.abs(camera - robot[np.ix_(order, order)])
    if np.array_equal(order, np.arange(len(order))) or not np.median(away) < _SAME_ORDER:
        return None
    return order.astype(np.int64)
