# SPDX-License-Identifier: Apache-2.0
"""Unknowns of a hand-eye problem, what is known of them beforehand, and where an estimate of them ended; m, rad, px."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from openarm_calibration.handeye.problem import Extra, Problem, layout
from openarm_calibration.handeye.spread import FLOOR
from openarm_calibration.handeye.transforms import skews
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array, Mask

#: Deviations of the joints' zeros that are compared, rad; the first says that zeros are right. Each answer starts from
#: the one before: from the wide end, joints that mounts take up would wander and come back slowly.
ZERO_SCALES = tuple(math.radians(degrees) for degrees in (0.001, 0.03, 0.06, 0.1, 0.2, 0.4, 1.0, 2.0, 4.0))


@dataclass(frozen=True)
class Noise:
    """Standard deviations by axis.

    Args:
        px: Noise of a detected mark, pixels.
        translation: Noise of the robot's pose, m; 0 is an exact robot.
        rotation: Noise of the robot's pose, rad.
        misfit: Noise that the marks of a view have in common, over what `px` makes of it; 0 without.
    """

    px: float
    translation: float = 0.0
    rotation: float = 0.0
    misfit: float = 0.0

    @property
    def prior(self) -> Array:
        """(6, 6) inverse covariance of a correction of A."""
        return np.diag(np.repeat(np.maximum((self.translation, self.rotation), FLOOR), 3) ** -2.0)

    @property
    def view_px(self) -> float:
        """Standard deviation that counts where views are compared, px by mark."""
        return self.px * math.sqrt(1.0 + self.misfit**2)

    def misfit_px(self, marks: float) -> float:
        """Return the rms of the misfit at `marks` marks of a view, px by axis."""
        return self.px * self.misfit * math.sqrt(3.0 / max(marks, 3.0))


@dataclass(frozen=True, eq=False)
class Priors:
    """What is known of the extras before anything is seen: standard deviations, infinite where nothing is.

    Args:
        scale: Scale of the board.
        delay: Delay of the images, s.
        focal: Deviation of fx and fy, as a fraction.
        centre: Deviation of cx and cy, px.
        distortion: Deviation of k1 and of k2.
        zeros: (joints,) of the offsets, rad; None: infinite.
        level: Boards that lie on a level table: deviation of the tilt about each axis by number of the board, rad.
    """

    scale: float = math.inf
    delay: float = math.inf
    focal: float = math.inf
    centre: float = math.inf
    distortion: float = math.inf
    zeros: Array | None = None
    level: Mapping[int, float] = field(default_factory=dict[int, float])

    def tilts(self, problem: Problem, Z: Array, size: int) -> tuple[Array, Array]:
        """Return by how much boards that lie on a level table are tilted, and how that changes, over its deviation.

        Args:
            problem: The views.
            Z: (boards, 4, 4) mounts, in a frame whose z axis is vertical.
            size: Number of parameters.

        Returns:
            (n,) tilts, and (n, size) their derivatives.
        """
        tilt, by = np.zeros(2 * len(self.level)), np.zeros((2 * len(self.level), size))
        for k, (board, deviation) in enumerate(self.level.items()):
            vertical, rows = Z[board, 2, :3], slice(2 * k, 2 * k + 2)
            turn = 6 * (problem.cameras + board) + 3
            tilt[rows] = vertical[:2] / deviation
            by[rows, turn : turn + 3] = skews(vertical[None])[0, :2] / deviation
        return tilt, by

    def of(self, problem: Problem, extras: Sequence[Extra]) -> tuple[Array, Array]:
        """Return the deviations and expected values (parameters,) of all columns; mounts are free.

        Args:
            problem: The views.
            extras: Unknowns besides the mounts.
        """
        columns = layout(problem, extras)
        size = max(part.stop for part in columns.values())
        sigma, expected = np.full(size, math.inf), np.zeros(size)
        rows = problem.intrinsics_rows
        for name, part in columns.items():
            if name == "scale":
                sigma[part], expected[part] = self.scale, 1.0
            elif name == "delay":
                sigma[part] = self.delay
            elif name == "intrinsics":
                centre = np.full((problem.cameras, 2), self.centre)
                sigma[part] = np.concatenate([rows[:, :2] * self.focal, centre], axis=1).ravel()
            elif name == "distortion":
                sigma[part] = self.distortion
            elif name == "zeros":
                sigma[part] = math.inf if self.zeros is None else np.maximum(self.zeros, FLOOR)
        return sigma, expected


FREE = Priors()


@dataclass(frozen=True, eq=False)
class Unknowns:
    """The unknowns.

    Args:
        X: (cameras, 4, 4) mounts of the cameras (optical frames).
        Z: (boards, 4, 4) mounts of the boards.
        correction: (poses, 6) of the robot's poses.
        intrinsics: (cameras, 4) changes of fx, fy, cx, cy, px.
        scale: Scale of the board.
        delay: Delay of the images, s.
        distortion: (cameras, 2) k1, k2.
        zeros: (joints,) offsets of the joints; without them A is that of the view, rad.
    """

    X: Array
    Z: Array
    correction: Array
    intrinsics: Array
    scale: float = 1.0
    delay: float = 0.0
    distortion: Array = field(default_factory=lambda: np.zeros((1, 2)))
    zeros: Array = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def start(cls, problem: Problem, X: Array, Z: Array) -> Unknowns:
        """Return mounts with nothing corrected."""
        cameras = problem.cameras
        return cls(
            X, Z, np.zeros((int(problem.pose.max()) + 1, 6)), np.zeros((cameras, 4)),
            distortion=np.zeros((cameras, 2)), zeros=np.zeros(problem.joints),
        )  # fmt: skip

    @property
    def optics(self) -> Array:
        """(cameras, 6) changes of fx, fy, cx, cy, k1, k2."""
        return np.concatenate([self.intrinsics, self.distortion], axis=1)

    def at_poses(self, problem: Problem) -> Array | None:
        """(n, 6) changes of A by the delay; None without any."""
        return -self.delay * problem.rate if self.delay else None


@dataclass(frozen=True, eq=False, kw_only=True)
class Estimate(Unknowns):
    """Where the refinement ended.

    Args:
        noise: Noise that was used, or found.
        information: (parameters, parameters), columns as `problem.design`.
        extras: Unknowns besides the mounts that were free.
        spread: (parameters, parameters) covariance where the robot's spread was estimated.
        evidence: Minus twice the log marginal likelihood; comparable between answers for the same pixels whose extras
            have finite priors.
    """

    noise: Noise
    information: Array
    extras: tuple[Extra, ...] = ()
    spread: Array | None = None
    evidence: float = math.nan

    def covariance(self) -> Array:
        """(parameters, parameters) of the unknowns; with an estimated robot it counts the doubt about its spread too.

        Raises:
            OpenArmError: DEGENERATE, when it does not exist.
        """
        return invert_scaled(self.information) if self.spread is None else self.spread


def at_zeros(problem: Problem, estimate: Estimate) -> Problem:
    """Return views with the robot poses that an estimate has, where the joints' zeros were free."""
    return problem.posed(estimate.zeros) if "zeros" in estimate.extras else problem


def values(problem: Problem, state: Unknowns, extras: Sequence[Extra]) -> Array:
    """Return the extras of a state (parameters,), in the columns of `layout`; 0 in those of the mounts.

    Args:
        problem: The views.
        state: The unknowns.
        extras: Unknowns besides the mounts.
    """
    columns = layout(problem, extras)
    out = np.zeros(max(part.stop for part in columns.values()))
    for extra in extras:
        out[columns[extra]] = np.ravel(getattr(state, extra))
    return out


def invert_scaled(information: Array) -> Array:
    """Return the inverse of a symmetric positive matrix whose columns differ in unit.

    Raises:
        OpenArmError: DEGENERATE, when it is singular.
    """
    diagonal = np.diag(information)
    if not (np.isfinite(information).all() and (diagonal > 0.0).all()):
        raise OpenArmError(Code.DEGENERATE, "some unknown is not determined; add poses that differ in rotation")
    scale = np.sqrt(diagonal)
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] <= 1e-14 * values[-1]:
        raise OpenArmError(Code.DEGENERATE, "the views leave an unknown free; add poses that differ in rotation")
    return (vectors / values) @ vectors.T / np.outer(scale, scale)


@dataclass(frozen=True)
class PoseTest:
    """One robot pose (all views taken at it) against the others.

    Args:
        distance: Squared distance by number of measurements, in units of what is expected (1 is usual).
        limit: Above it the pose contradicts the others.
        influence: Change of the answer without it, in standard deviations of the answer (Cook's distance).
        translation: Contradiction of the worst view, m at the board.
        rotation: The same, rad.
    """

    distance: float
    limit: float
    influence: float
    translation: float
    rotation: float


@dataclass(frozen=True, eq=False)
class Outlier:
    """A view that was left out."""

    name: str
    index: int
    reason: str


@dataclass(frozen=True, eq=False)
class Solution:
    """Mounts and the data they are computed from.

    Args:
        problem: All views.
        used: (n,) which views the estimate rests on.
        estimate: The refinement.
        outliers: The other views, with reasons.
        tests: Each robot pose against the prediction of the others.
        condition: Condition number of the information, in units of 1 mm and 0.1°.
    """

    problem: Problem
    used: Mask
    estimate: Estimate
    outliers: tuple[Outlier, ...]
    tests: tuple[PoseTest, ...]
    condition: float

    def mount_covariance(self, camera: int = 0) -> Array:
        """(6, 6) covariance of a camera's mount: position in the parent's axes (m), rotation in its own (rad)."""
        block = slice(6 * camera, 6 * camera + 6)
        return self.estimate.covariance()[block, block]

    def sigma(self, camera: int = 0) -> tuple[float, float]:
        """Predicted error of a camera's mount: standard deviation of position (m) and rotation (rad) as vectors."""
        covariance = self.mount_covariance(camera)
        return math.sqrt(np.trace(covariance[:3, :3])), math.sqrt(np.trace(covariance[3:, 3:]))
