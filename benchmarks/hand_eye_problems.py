# SPDX-License-Identifier: Apache-2.0
"""Hand-eye problems with a known answer, for benchmarks and tests.

A 1280×720 camera of 900 px focal length observes a 4×11 circle grid: from the hand at 0.30 to 0.55 m, from the base at
0.45 to 0.75 m, tilted by 5° to 40°. Noise is normal by axis: px on the marks, m and rad on the robot's pose.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.handeye.problem import BoardView, Problem, Setup, assemble, project
from openarm_calibration.handeye.refine import information_at
from openarm_calibration.handeye.transforms import inverses, moved
from openarm_calibration.handeye.unknowns import Noise
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.draws import until
from openarm_common.types import Array

INTRINSICS = Intrinsics(1280, 720, 900.0, 900.0, 640.0, 360.0)
BOARD = CircleGrid()
_ROW = np.array([INTRINSICS.fx, INTRINSICS.fy, INTRINSICS.cx, INTRINSICS.cy])


@dataclass(frozen=True, eq=False)
class Truth:
    """A problem and its answer: (4, 4) X and Z, (n, 4, 4) robot poses without their error."""

    problem: Problem
    X: Array
    Z: Array
    A: Array

    def bound(self, noise: Noise) -> Array:
        """Return (12, 12) Cramér-Rao bound on the covariance of X and Z."""
        information = information_at(with_poses(self.problem, self.A), self.X[None], self.Z[None], noise)
        return np.linalg.inv(information).astype(np.float64)


def with_poses(problem: Problem, A: Array) -> Problem:
    """Return the views of a problem with other robot poses (n, 4, 4)."""
    views = [replace(view, A=a) for view, a in zip(problem.views, A, strict=True)]
    return assemble(views, problem.intrinsics, list(problem.free))


def mounts(setup: Setup) -> tuple[Array, Array]:
    """Return the true X and Z."""
    if setup == "in_hand":
        return (
            se3.make(se3.exp_so3((0.05, -0.1, 1.5)), (0.03, -0.05, 0.06)),
            se3.make(se3.exp_so3((0.02, -0.03, 0.4)), (0.45, 0.1, 0.02)),
        )
    return (
        se3.make(se3.exp_so3((math.pi * 0.98, 0.05, 0.1)), (0.4, 0.0, 1.1)),
        se3.make(se3.exp_so3((0.1, 0.2, 0.3)), (0.01, 0.02, 0.08)),
    )


def views(setup: Setup, count: int, rng: np.random.Generator) -> Array:
    """Return (count, 4, 4) T_camera_board with all marks in the image.

    Args:
        setup: in_hand or to_hand.
        count: How many.
        rng: Of everything random.
    """
    near, far = (0.30, 0.55) if setup == "in_hand" else (0.45, 0.75)
    out: list[Array] = []
    for _ in until(lambda: len(out) >= count, "views of the whole board", "take a smaller board", 1000 * count):
        tilt, around = math.radians(rng.uniform(5.0, 40.0)), rng.uniform(0.0, math.tau)
        direction = np.array([math.sin(tilt) * math.cos(around), math.sin(tilt) * math.sin(around), -math.cos(tilt)])
        eye = rng.uniform(near, far) * direction
        target = np.append(rng.uniform(-0.05, 0.05, 2), 0.0)
        T_board_camera = se3.make(se3.rotation_from_z_y(target - eye, (-0.1, 1.0, 0.0)), eye)
        T_board_camera[:3, :3] = T_board_camera[:3, :3] @ se3.rot_z(math.radians(rng.uniform(-60.0, 60.0)))
        T = se3.inverse(T_board_camera)
        pixels = project(BOARD.points, 0.0, T, _ROW)
        if (pixels > 5.0).all() and (pixels < (INTRINSICS.width - 5.0, INTRINSICS.height - 5.0)).all():
            out.append(T)
    return np.array(out)


def make(setup: Setup, C: Array, noise: Noise, rng: np.random.Generator) -> Truth:
    """Return the problem of given views C (n, 4, 4) T_camera_board, with noise.

    Args:
        setup: in_hand or to_hand.
        C: (n, 4, 4).
        noise: Standard deviations.
        rng: Of everything random.
    """
    X, Z = mounts(setup)
    B = X @ C @ inverses(Z)
    A = inverses(B) if setup == "in_hand" else B
    error = rng.normal(0.0, 1.0, (len(C), 6)) * np.repeat((noise.translation, noise.rotation), 3)
    reported = moved(A, error)
    seen = [project(BOARD.points, BOARD.radius, T, _ROW) + rng.normal(0.0, noise.px, (len(BOARD.points), 2)) for T in C]
    listed = [
        BoardView(BOARD.points, pixels, reported[i], setup, radius=BOARD.radius, pose=i, name=f"s{i:02d}")
        for i, pixels in enumerate(seen)
    ]
    return Truth(assemble(listed, [INTRINSICS], list(C)), X, Z, A)


def trial(setup: Setup, count: int, noise: Noise, rng: np.random.Generator) -> Truth:
    """Return a random problem of `count` poses.

    Args:
        setup: in_hand or to_hand.
        count: Poses.
        noise: Standard deviations.
        rng: Of everything random.
    """
    return make(setup, views(setup, count, rng), noise, rng)


DEGENERATE = ("translation", "axis", "turntable", "identical")


def degenerate(kind: str, setup: Setup, rng: np.random.Generator, amount: float = 0.0, count: int = 10) -> Truth:
    """Return a problem whose robot poses move in one way only.

    Args:
        kind: translation, axis (one rotation axis and translations), turntable (one axis), identical.
        setup: in_hand or to_hand.
        rng: Of everything random.
        amount: Free rotation besides, rad by axis; makes the set nearly degenerate.
        count: Poses.
    """
    X, Z = mounts(setup)
    B = X @ views(setup, 1, rng)[0] @ se3.inverse(Z)
    first = se3.inverse(B) if setup == "in_hand" else B
    change = np.zeros((count, 6))
    if kind in ("translation", "axis"):
        change[:, :3] = rng.uniform(-0.03, 0.03, (count, 3))
    if kind in ("axis", "turntable"):
        change[:, 5] = np.radians(np.linspace(-20.0, 16.0, count))
    change[:, 3:] += rng.normal(0.0, 1.0, (count, 3)) * amount
    A = moved(np.broadcast_to(first, (count, 4, 4)).copy(), change)
    C = inverses(np.broadcast_to(X, A.shape)) @ (inverses(A) if setup == "in_hand" else A) @ Z
    return make(setup, C, Noise(0.3), rng)
