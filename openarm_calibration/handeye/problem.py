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

Pixels of marks are exact, with derivatives. The centre of the image of a circle is not the image of its centre. With
`o` the circle's centre and `n` the board's normal in the optical frame (m), `r` its radius, the image ellipse has in
normalised coordinates the dual conic `r² (I - n nᵀ) - o oᵀ`, whose centre is the quotient used below; `r = 0` is a
plain point. Derivatives are taken by a camera-frame twist (translation, rotation) of the board, then by the scale of
the board, then by fx, fy, cx, cy: `COLUMNS` in all.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array

Indices = NDArray[np.int64]

#: Twist (6), scale (1), intrinsics (4).
COLUMNS = 11
#: Nearer than this in front of the camera a mark has no image, m.
_NEAR = 1e-3


@njit(cache=True, nogil=True)
def _mark(
    p: Array, radius: float, T: Array, intrinsics: Array, scale: float, rows: Array, pixel: Array
) -> bool:  # pragma: no cover - compiled
    """Return the pixel (2,) and derivative rows (2, 11) of one mark; False behind the camera."""
    o = np.empty(3)
    arm = np.empty(3)
    for k in range(3):
        arm[k] = T[k, 0] * p[0] + T[k, 1] * p[1] + T[k, 2] * p[2]
        o[k] = scale * arm[k] + T[k, 3]
    if not o[2] > _NEAR:
        return False
    nx, ny, nz = T[0, 2], T[1, 2], T[2, 2]
    rr = radius * radius * scale * scale
    den = o[2] * o[2] - rr * (1.0 - nz * nz)
    if not den > 0.0:
        return False
    n = np.empty(3)
    n[0], n[1], n[2] = nx, ny, nz
    g = np.empty(3)
    h = np.empty(3)
    for axis in range(2):
        other = 1 - axis
        value = (o[axis] * o[2] + rr * n[axis] * nz) / den
        g[axis] = o[2] / den
        g[other] = 0.0
        g[2] = (o[axis] - 2.0 * value * o[2]) / den
        h[axis] = rr * nz / den
        h[other] = 0.0
        h[2] = rr * (n[axis] - 2.0 * value * nz) / den
        by_rr = (n[axis] * nz + value * (1.0 - nz * nz)) / den
        f = intrinsics[axis]
        pixel[axis] = f * value + intrinsics[2 + axis]
        rows[axis, 0], rows[axis, 1], rows[axis, 2] = f * g[0], f * g[1], f * g[2]
        rows[axis, 3] = f * (o[1] * g[2] - o[2] * g[1] + n[1] * h[2] - n[2] * h[1])
        rows[axis, 4] = f * (o[2] * g[0] - o[0] * g[2] + n[2] * h[0] - n[0] * h[2])
        rows[axis, 5] = f * (o[0] * g[1] - o[1] * g[0] + n[0] * h[1] - n[1] * h[0])
        rows[axis, 6] = f * (g[0] * arm[0] + g[1] * arm[1] + g[2] * arm[2] + by_rr * 2.0 * radius * radius * scale)
        rows[axis, 7 + axis] = value
        rows[axis, 7 + other] = 0.0
        rows[axis, 9 + axis] = 1.0
        rows[axis, 9 + other] = 0.0
    return True


@njit(cache=True, nogil=True)
def normal_equations(
    points: Array,
    pixels: Array,
    offsets: Indices,
    radii: Array,
    poses: Array,
    intrinsics: Array,
    scale: float,
) -> tuple[Array, Array, Array]:  # pragma: no cover - compiled
    """Return the normal equations of each view, in px².

    Args:
        points: (marks, 3) of all views, board frame, m.
        pixels: (marks, 2) measured.
        offsets: (views + 1,) first mark of each view.
        radii: (views,) radius of the circles, m; 0 for points.
        poses: (views, 4, 4) T_camera_board.
        intrinsics: (views, 4) fx, fy, cx, cy.
        scale: Of the board.

    Returns:
        (views, 11, 11) JᵀJ, (views, 11) Jᵀr and (views,) rᵀr; the last is infinite with a mark behind the camera.
    """
    count = len(offsets) - 1
    squares = np.zeros((count, COLUMNS, COLUMNS))
    slopes = np.zeros((count, COLUMNS))
    costs = np.zeros(count)
    rows = np.zeros((2, COLUMNS))
    pixel = np.zeros(2)
    for view in range(count):
        for mark in range(offsets[view], offsets[view + 1]):
            if not _mark(points[mark], radii[view], poses[view], intrinsics[view], scale, rows, pixel):
                costs[view] = np.inf
                break
            for axis in range(2):
                residual = pixels[mark, axis] - pixel[axis]
                costs[view] += residual * residual
                for i in range(COLUMNS):
                    slopes[view, i] += rows[axis, i] * residual
                    for j in range(i + 1):
                        squares[view, i, j] += rows[axis, i] * rows[axis, j]
        for i in range(COLUMNS):
            for j in range(i):
                squares[view, j, i] = squares[view, i, j]
    return squares, slopes, costs


@njit(cache=True, nogil=True)
def project(
    points: Array, radius: float, pose: Array, intrinsics: Array, scale: float = 1.0
) -> Array:  # pragma: no cover - compiled
    """Return pixels (n, 2) of marks (n, 3); NaN behind the camera.

    Args:
        points: (n, 3) marks in the board frame, m.
        radius: Of the circles, m; 0 for points.
        pose: (4, 4).
        intrinsics: (4,) fx, fy, cx, cy.
        scale: Of the board.
    """
    out = np.full((len(points), 2), np.nan)
    rows = np.zeros((2, COLUMNS))
    pixel = np.zeros(2)
    for mark in range(len(points)):
        if _mark(points[mark], radius, pose, intrinsics, scale, rows, pixel):
            out[mark] = pixel
    return out


@njit(cache=True, nogil=True)
def turned(R: Array, w: Array) -> Array:  # pragma: no cover - compiled
    """Return `exp(w) R` for a rotation vector w (3,)."""
    angle = np.sqrt(w[0] * w[0] + w[1] * w[1] + w[2] * w[2])
    K = np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])
    if angle < 1e-9:
        E = np.eye(3) + K
    else:
        E = np.eye(3) + np.sin(angle) / angle * K + (1.0 - np.cos(angle)) / (angle * angle) * (K @ K)
    return E @ R


@njit(cache=True, nogil=True)
def fit_poses(
    points: Array,
    pixels: Array,
    offsets: Indices,
    radii: Array,
    poses: Array,
    intrinsics: Array,
    iterations: int = 12,
) -> tuple[Array, Array]:  # pragma: no cover - compiled
    """Return the least-squares pose of the board in each view by itself.

    Args:
        points: (marks, 3).
        pixels: (marks, 2).
        offsets: (views + 1,).
        radii: (views,).
        poses: (views, 4, 4) to start from; kept where no step makes the residual smaller.
        intrinsics: (views, 4).
        iterations: At most.

    Returns:
        (views, 4, 4) T_camera_board and (views,) sums of squared residuals, px².
    """
    out = poses.copy()
    _, _, first = normal_equations(points, pixels, offsets, radii, out, intrinsics, 1.0)
    final = first.copy()
    for view in range(len(offsets) - 1):
        marks = slice(offsets[view], offsets[view + 1])
        own_points, own_pixels = points[marks], pixels[marks]
        own_offsets = np.array([0, offsets[view + 1] - offsets[view]])
        own_radii, own_intrinsics = radii[view : view + 1], intrinsics[view : view + 1]
        pose = out[view : view + 1].copy()
        damping = 1e-9
        for _ in range(iterations):
            A, b, cost = normal_equations(own_points, own_pixels, own_offsets, own_radii, pose, own_intrinsics, 1.0)
            H = A[0, :6, :6].copy()
            for k in range(6):
                H[k, k] *= 1.0 + damping
            step = np.linalg.solve(H, b[0, :6].copy())
            trial = pose.copy()
            trial[0, :3, :3] = turned(np.ascontiguousarray(pose[0, :3, :3]), step[3:])  # pyright: ignore[reportArgumentType]
            w = step[3:]
            t = pose[0, :3, 3]
            trial[0, 0, 3] = t[0] + step[0] + w[1] * t[2] - w[2] * t[1]
            trial[0, 1, 3] = t[1] + step[1] + w[2] * t[0] - w[0] * t[2]
            trial[0, 2, 3] = t[2] + step[2] + w[0] * t[1] - w[1] * t[0]
            _, _, reached = normal_equations(own_points, own_pixels, own_offsets, own_radii, trial, own_intrinsics, 1.0)
            if reached[0] <= cost[0]:
                pose = trial
                final[view] = reached[0]
                damping = max(damping * 0.1, 1e-12)
                if cost[0] - reached[0] <= 1e-12 * cost[0]:
                    break
            else:
                damping = max(damping, 1e-6) * 30.0
                if damping > 1e6:
                    break
        out[view] = pose[0]
    return out, final


# --- the problem
Setup = Literal["in_hand", "to_hand", "fixed"]
SETUPS: tuple[Setup, ...] = ("in_hand", "to_hand", "fixed")
#: Unknowns besides the mounts: scale of the board (true over stated), delay of the images (s), intrinsics (px).
Extra = Literal["scale", "delay", "intrinsics"]


@dataclass(frozen=True, eq=False)
class View:
    """One board in one image.

    Args:
        points: (n, 3) marks in the board frame, m.
        pixels: (n, 2) where they were detected.
        A: (4, 4) T_base_gripper at the stamp of the image, as the robot reports; not used when `fixed`.
        setup: Which of camera and board the gripper carries.
        radius: Of the circles, m; 0 for corner points.
        camera: Index of the camera.
        board: Index of the board mount.
        pose: Number of the robot pose; views of the same one share its error.
        name: What the view is called in reports.
        rate: (6,) how fast A changes, in its own six numbers a second; zero at rest.
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


@dataclass(frozen=True, eq=False)
class Problem:
    """Views in the form that the solver reads; made by `assemble`, cut by `subset`."""

    views: tuple[View, ...]
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
    def marks(self) -> Indices:
        """(n,) marks of each view."""
        return np.diff(self.offsets)

    @property
    def intrinsics_rows(self) -> Array:
        """(cameras, 4) fx, fy, cx, cy."""
        return np.array([[k.fx, k.fy, k.cx, k.cy] for k in self.intrinsics])

    def camera_rows(self, change: Array | float = 0.0) -> Array:
        """Return (n, 4) fx, fy, cx, cy of each view's camera, changed by (cameras, 4)."""
        return (self.intrinsics_rows + change)[self.camera]

    def equations(self, T: Array, change: Array | float = 0.0, scale: float = 1.0) -> tuple[Array, Array, Array]:
        """Return `normal_equations` at poses (n, 4, 4), a change of the intrinsics (cameras, 4) and a board scale."""
        return normal_equations(self.points, self.pixels, self.offsets, self.radii, T, self.camera_rows(change), scale)

    def subset(self, keep: Sequence[int] | Indices | NDArray[np.bool_]) -> Problem:
        """Return the problem with some of its views (indices or a mask); the per-view fits are kept."""
        chosen = np.arange(len(self))[np.asarray(keep)]
        views = tuple(self.views[i] for i in chosen)
        return _pack(views, self.intrinsics, self.free[chosen], self.free_cost[chosen])


def assemble(views: Sequence[View], intrinsics: Sequence[Intrinsics], guesses: Sequence[Array]) -> Problem:
    """Make a problem of views.

    Args:
        views: At least one.
        intrinsics: Of each camera.
        guesses: (4, 4) T_camera_board of each view, near enough for least squares (see `detect.guess_pose`).
    """
    raw = _pack(tuple(views), tuple(intrinsics), np.array(guesses), np.zeros(len(views)))
    free, cost = fit_poses(raw.points, raw.pixels, raw.offsets, raw.radii, raw.free, raw.camera_rows())
    return replace(raw, free=free, free_cost=cost)


def _pack(views: tuple[View, ...], intrinsics: tuple[Intrinsics, ...], free: Array, cost: Array) -> Problem:
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
    )


# --- transforms, batched over (..., 4, 4)
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
    if "intrinsics" in columns:
        for k in range(4):
            G[index, 7 + k, columns["intrinsics"].start + 4 * problem.camera + k] = 1.0
    return G, by_A
