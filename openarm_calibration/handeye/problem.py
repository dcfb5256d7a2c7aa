# SPDX-License-Identifier: Apache-2.0
"""The hand-eye problem: views of boards by cameras, and how its unknowns move a view.

A view sees `T_camera_board = X⁻¹ B Z`, where X is the mount of the camera and Z that of the board, each on what
carries it, and B comes from the robot's pose A = T_base_gripper:

* ``in_hand``: the gripper carries the camera, the base the board; X = T_gripper_camera, Z = T_base_board, B = A⁻¹.
* ``to_hand``: the base carries the camera, the gripper the board; X = T_base_camera, Z = T_gripper_board, B = A.
* ``fixed``: the base carries both; B is the identity. Such a view ties a camera to a board that another one sees.

Every camera is the optical frame. A change of a mount or of A is six numbers: the translation in the parent's axes
(m), then the rotation vector in its own axes (rad): `(p, R) → (p + d, R exp(w))`. All of them move the view by a
twist in the camera's frame, so that a view counts only by its 6×6 normal equations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from openarm_calibration.handeye.marks import BEFORE_OPTICS, Indices, fit_poses, normal_equations, project
from openarm_calibration.handeye.transforms import inverses, moved, skews
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array

#: Twist, scale, fx, fy, cx, cy, k1, k2.
COLUMNS = BEFORE_OPTICS + 6

Setup = Literal["in_hand", "to_hand", "fixed"]
SETUPS: tuple[Setup, ...] = ("in_hand", "to_hand", "fixed")
#: Unknowns besides the mounts: scale of the board (true over stated), delay of the images (s), intrinsics (px),
#: distortion (k1, k2), zeros of the joints (rad).
Extra = Literal["scale", "delay", "intrinsics", "distortion", "zeros"]
EXTRAS: tuple[Extra, ...] = ("scale", "delay", "intrinsics", "distortion", "zeros")


class ViewJoints(Protocol):
    """Joint positions behind a robot pose."""

    @property
    def count(self) -> int:
        """Number of offsets."""
        ...

    def scaled(self, factor: float) -> ViewJoints:
        """Return the same with positions in another unit."""
        ...

    def at(self, zeros: Array) -> tuple[Array, Array]:
        """Return A (4, 4) at offsets (count,) of the zeros, and how it changes with each (6, count)."""
        ...


@dataclass(frozen=True, eq=False)
class BoardView:
    """One board in one image.

    Args:
        points: (n, 3) marks in the board frame, m.
        pixels: (n, 2) where they were detected.
        A: (4, 4) T_base_gripper at the stamp of the image, as the robot reports; not used when `fixed`.
        setup: Which of camera and board the gripper carries: eye-in-hand or eye-to-hand.
        radius: Radius of the circles, m; 0 for corner points.
        camera: Index of the camera.
        board: Index of the board mount.
        pose: Number of the robot pose; views of the same one share its error.
        name: Name of the view in reports.
        rate: (6,) how fast A changes, in its own six numbers a second; zero at rest.
        arm: The joints that A comes from, the same in all views; None where A alone is known.
    """

    points: Array
    pixels: Array
    A: Array
    setup: Setup
    radius: float = 0.0
    camera: int = 0
    board: int = 0
    pose: int = 0
    name: str = ""
    rate: Array = field(default_factory=lambda: np.zeros(6))
    arm: ViewJoints | None = None


@dataclass(frozen=True, eq=False)
class Problem:
    """Views in the form that the solver reads; made by `assemble`, cut by `subset`."""

    views: tuple[BoardView, ...]
    intrinsics: tuple[Intrinsics, ...]
    free: Array  # (n, 4, 4) T_camera_board of each view by itself
    free_cost: Array  # (n,) its sum of squared residuals, px²
    points: Array
    pixels: Array
    offsets: Indices
    radii: Array
    A: Array
    kind: Indices  # index into SETUPS
    camera: Indices
    board: Indices
    pose: Indices
    rate: Array
    by_joints: Array  # (n, 6, joints) how A changes with the zeros; see `posed`

    def __len__(self) -> int:
        """Return the number of views."""
        return len(self.views)

    @property
    def cameras(self) -> int:
        """Number of cameras."""
        return len(self.intrinsics)

    @property
    def boards(self) -> int:
        """Number of board mounts."""
        return int(self.board.max()) + 1

    @property
    def joints(self) -> int:
        """Number of joints whose zeros may be unknowns."""
        return 0 if self.views[0].arm is None else self.views[0].arm.count

    @property
    def marks(self) -> Indices:
        """(n,) marks of each view."""
        return np.diff(self.offsets)

    @property
    def intrinsics_rows(self) -> Array:
        """(cameras, 4) fx, fy, cx, cy."""
        return np.array([[k.fx, k.fy, k.cx, k.cy] for k in self.intrinsics])

    def camera_rows(self, change: Array | float = 0.0) -> Array:
        """Return (n, 6) fx, fy, cx, cy, k1, k2 of each view's camera, changed by (cameras, 6)."""
        stated = np.concatenate([self.intrinsics_rows, np.zeros((self.cameras, 2))], axis=1)
        return (stated + change)[self.camera]

    def equations(self, T: Array, change: Array | float = 0.0, scale: float = 1.0) -> tuple[Array, Array, Array]:
        """Return `normal_equations` at poses (n, 4, 4), a change of the intrinsics (cameras, 6) and a board scale."""
        return normal_equations(self.points, self.pixels, self.offsets, self.radii, T, self.camera_rows(change), scale)

    def subset(self, keep: Sequence[int] | Indices | NDArray[np.bool_]) -> Problem:
        """Return the problem with some of its views (indices or a mask); the per-view fits are kept."""
        chosen = np.arange(len(self))[np.asarray(keep)]
        views = tuple(self.views[i] for i in chosen)
        return _pack(views, self.intrinsics, self.free[chosen], self.free_cost[chosen])

    def posed(self, zeros: Array) -> Problem:
        """Return the views with the robot poses that follow from the joints at offsets (joints,) of their zeros."""
        found = [view.arm.at(zeros) for view in self.views if view.arm is not None]
        if len(found) < len(self):
            return self
        return replace(self, A=np.array([A for A, _ in found]), by_joints=np.array([by for _, by in found]))


def assemble(views: Sequence[BoardView], intrinsics: Sequence[Intrinsics], guesses: Sequence[Array]) -> Problem:
    """Make a problem of views.

    Args:
        views: Views, at least one.
        intrinsics: Intrinsics of each camera.
        guesses: (4, 4) T_camera_board of each view, near enough for least squares (see `detect.guess_pose`).
    """
    raw = _pack(tuple(views), tuple(intrinsics), np.array(guesses), np.zeros(len(views)))
    free, cost = fit_poses(raw.points, raw.pixels, raw.offsets, raw.radii, raw.free, raw.camera_rows())
    return replace(raw, free=free, free_cost=cost)


def _pack(views: tuple[BoardView, ...], intrinsics: tuple[Intrinsics, ...], free: Array, cost: Array) -> Problem:
    _, pose = np.unique([view.pose for view in views], return_inverse=True)
    return Problem(
        views,
        intrinsics,
        np.ascontiguousarray(free),
        cost,
        points=np.ascontiguousarray(np.concatenate([view.points for view in views])),
        pixels=np.ascontiguousarray(np.concatenate([view.pixels for view in views])),
        offsets=np.concatenate([[0], np.cumsum([len(view.points) for view in views])]).astype(np.int64),
        radii=np.array([view.radius for view in views], dtype=np.float64),
        A=np.array([view.A for view in views], dtype=np.float64),
        kind=np.array([SETUPS.index(view.setup) for view in views], dtype=np.int64),
        camera=np.array([view.camera for view in views], dtype=np.int64),
        board=np.array([view.board for view in views], dtype=np.int64),
        pose=np.asarray(pose, dtype=np.int64).reshape(-1),
        rate=np.array([view.rate for view in views], dtype=np.float64),
        by_joints=np.zeros((len(views), 6, 0)),
    )


def chain(problem: Problem, X: Array, Z: Array, correction: Array | None = None) -> tuple[Array, Array]:
    """Predict `T_camera_board` and B of each view.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
        correction: (n, 6) of A; None corrects nothing.

    Returns:
        (n, 4, 4) T_camera_board and (n, 4, 4) B.
    """
    A = problem.A if correction is None else moved(problem.A, correction)
    kind = problem.kind[:, None, None]
    B = np.where(kind == 0, inverses(A), np.where(kind == 1, A, np.eye(4)))
    return inverses(X)[problem.camera] @ B @ Z[problem.board], B


def residuals(problem: Problem, X: Array, Z: Array) -> list[Array]:
    """Return measured minus predicted pixels (marks, 2) of each view; NaN behind the camera.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
    """
    T, _ = chain(problem, X, Z)
    return [
        view.pixels - project(view.points, view.radius, pose, row)
        for view, pose, row in zip(problem.views, T, problem.camera_rows(), strict=True)
    ]


def sensitivity(problem: Problem, X: Array, Z: Array, T: Array, B: Array) -> tuple[Array, Array, Array]:
    """How the view (camera-frame twist) moves with its camera's mount, its board's mount and A; each (n, 6, 6).

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
        T: (n, 4, 4) T_camera_board, from `chain`.
        B: (n, 4, 4), from `chain`.
    """
    RX = X[problem.camera][:, :3, :3]
    RXt = RX.swapaxes(1, 2)
    n = len(problem)
    by_X, by_Z, by_A = np.zeros((n, 6, 6)), np.zeros((n, 6, 6)), np.zeros((n, 6, 6))
    by_X[:, :3, :3] = -RXt
    by_X[:, 3:, 3:] = -np.eye(3)
    RT = T[:, :3, :3]
    by_Z[:, :3, :3] = RXt @ B[:, :3, :3]
    by_Z[:, :3, 3:] = skews(T[:, :3, 3]) @ RT
    by_Z[:, 3:, 3:] = RT
    X_inverse = inverses(X)[problem.camera]
    inside, outside = problem.kind == 0, problem.kind == 1
    by_A[inside, :3, :3] = -(RXt @ B[:, :3, :3])[inside]  # B is A⁻¹: its rotation is that of A transposed
    by_A[inside, :3, 3:] = -(skews(X_inverse[:, :3, 3]) @ RXt)[inside]
    by_A[inside, 3:, 3:] = -RXt[inside]
    Q = X_inverse @ B
    by_A[outside, :3, :3] = RXt[outside]
    by_A[outside, :3, 3:] = (skews(Q[:, :3, 3]) @ Q[:, :3, :3])[outside]
    by_A[outside, 3:, 3:] = Q[outside, :3, :3]
    return by_X, by_Z, by_A


def layout(problem: Problem, extras: Sequence[Extra]) -> dict[str, slice]:
    """Return the columns of the unknowns: six for each camera's X, six for each board's Z, the extras in their order.

    Args:
        problem: The views.
        extras: More unknowns.
    """
    widths = {
        "X": 6 * problem.cameras, "Z": 6 * problem.boards, "scale": 1, "delay": 1, "intrinsics": 4 * problem.cameras,
        "distortion": 2 * problem.cameras, "zeros": problem.joints,
    }  # fmt: skip
    out: dict[str, slice] = {}
    end = 0
    for name in ("X", "Z", *extras):
        out[name] = slice(end, end + widths[name])
        end += widths[name]
    return out


def design(problem: Problem, X: Array, Z: Array, T: Array, B: Array, extras: Sequence[Extra]) -> tuple[Array, Array]:
    """Return how the unknowns move each view.

    Args:
        problem: The views.
        X: (cameras, 4, 4).
        Z: (boards, 4, 4).
        T: (n, 4, 4) T_camera_board, from `chain`.
        B: (n, 4, 4), from `chain`.
        extras: More unknowns.

    Returns:
        (n, COLUMNS, parameters), with columns as `layout`, and, for the corrections of A, (n, 6, 6).
    """
    by_X, by_Z, by_A = sensitivity(problem, X, Z, T, B)
    columns = layout(problem, extras)
    G = np.zeros((len(problem), COLUMNS, max(part.stop for part in columns.values())))
    index = np.arange(len(problem))
    for k in range(6):
        G[index, :6, 6 * problem.camera + k] = by_X[:, :, k]
        G[index, :6, 6 * (problem.cameras + problem.board) + k] = by_Z[:, :, k]
    if "scale" in columns:
        G[:, 6, columns["scale"]] = 1.0
    if "delay" in columns:
        # an image that is `delay` old shows A as it was: A(t - delay)
        G[:, :6, columns["delay"]] = -(by_A @ problem.rate[:, :, None])
    for name, first, count in (("intrinsics", BEFORE_OPTICS, 4), ("distortion", BEFORE_OPTICS + 4, 2)):
        for k in range(count if name in columns else 0):
            G[index, first + k, columns[name].start + count * problem.camera + k] = 1.0
    if "zeros" in columns:
        G[:, :6, columns["zeros"]] = by_A @ problem.by_joints
    return G, by_A
