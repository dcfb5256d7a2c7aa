# SPDX-License-Identifier: Apache-2.0
"""Sessions with a known mount on the arm's own kinematics, and pictures of boards, for tests; m, rad, px."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Literal

import cv2
import numpy as np

from openarm_calibration.board.board import Board, CircleGrid
from openarm_calibration.board.detect import BoardDetection
from openarm_calibration.handeye.problem import project
from openarm_calibration.sampling.samples import Sample, SampleSet, SessionHead
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, Intrinsics, load_cameras, true_mount
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

BOARD = CircleGrid()
#: Joints of the right arm with which its camera looks down, rad.
_ABOVE_TABLE = (0.4, 3.1, -0.6, 1.95, 0.25, 0.7, 1.2)


@dataclass(frozen=True, eq=False)
class Known:
    """Samples and the true mount (optical frame)."""

    samples: SampleSet
    X: Array
    description: RobotDescription


@cache
def _drawn(board: Board, scale: float) -> Array:
    return board.draw(scale)


def photograph(board: Board, T_camera_board: Array, optics: Intrinsics, end: Array | None = None) -> Array:
    """Return the grey picture (h, w) of a board alone, 16 samples a pixel; 0 to 255.

    Args:
        board: The board.
        T_camera_board: (4, 4).
        optics: Of the camera.
        end: (2,) where the paper ends, m from its middle, before something dark; one sample a pixel then.
    """
    scale, zoom = 4000.0, 4 if end is None else 1
    w, h = board.size
    drawn = _drawn(board, scale)
    if end is not None:
        far_u, far_v = (np.abs(np.arange(n) / scale - edge / 2) > at for n, edge, at in zip(
            drawn.shape[::-1], (w, h), end, strict=True))  # fmt: skip
        drawn = np.where(far_v[:, None] | far_u, 56, drawn).astype(np.uint8)
    to_board = np.array([[1 / scale, 0, 0.5 / scale - w / 2], [0, 1 / scale, 0.5 / scale - h / 2], [0, 0, 1]])
    K = optics.matrix
    K[:2] *= zoom
    K[:2, 2] += (zoom - 1) / 2
    H = K @ T_camera_board[:3, [0, 1, 3]] @ to_board
    around, way = (130.0, cv2.INTER_LINEAR) if end is None else (56.0, cv2.INTER_NEAREST)
    large = cv2.warpPerspective(
        drawn, H, (optics.width * zoom, optics.height * zoom), flags=way, borderValue=(around,)
    )  # fmt: skip
    if end is not None:
        return large
    return cv2.resize(large, (optics.width, optics.height), interpolation=cv2.INTER_AREA).astype(np.float64)


def make_session(
    setup: Literal["in_hand", "to_hand"] = "in_hand",
    count: int = 15,
    px: float = 0.05,
    *,
    delay: float = 0.0,
    speed: float = 0.0,
    spread: float = 0.35,
    seed: int = 0,
    arm: str = "right",
    zeros: Mapping[str, float] | None = None,
    lying: bool = False,
) -> Known:
    """Return samples at random joints around a view of the board.

    With `speed` (rad/s) the arm moves at every image; `arm` holds the board of a fixed camera; joints report their
    positions minus `zeros` (rad); a board that is `lying` is level, below
    a camera in the hand.
    """
    rng = np.random.default_rng(seed)
    description = RobotDescription.load()
    cameras = load_cameras()
    camera = cameras["wrist" if setup == "in_hand" else "overhead"]
    carrier = camera.parent if setup == "in_hand" else f"openarm_{arm}_link7"
    k = camera.intrinsics
    head = SessionHead(
        camera=camera.name, setup=setup, parent=camera.parent, carrier=carrier, mount_seed=1,
        intrinsics=(k.width, k.height, k.fx, k.fy, k.cx, k.cy), board=BOARD.model_dump(),
    )  # fmt: skip
    samples = SampleSet(head, description)
    names = samples.joint_names
    home = description.group_state(f"{arm}_arm", "home")
    middle = np.array(_ABOVE_TABLE if lying else [home[name] for name in names])
    X = true_mount(camera, 1) @ T_LINK_OPTICAL
    A = samples.pose(dict(zip(names, middle, strict=True)))
    seen = se3.make(se3.rot_x(0.3) @ se3.rot_z(0.2), (0.0, 0.0, 0.36 if setup == "in_hand" else 0.6))
    if lying:
        seen[:3, :3] = (A @ X)[:3, :3].T @ se3.rotation_from_z_y((0.0, 0.0, -1.0), (-1.0, 0.0, 0.0))
    Z = A @ X @ seen if setup == "in_hand" else se3.inverse(A) @ X @ seen
    row = np.array([k.fx, k.fy, k.cx, k.cy])

    def view(q: Array) -> tuple[Array, Array] | None:
        A = samples.pose(dict(zip(names, q, strict=True)))
        T = se3.inverse(X) @ (se3.inverse(A) if setup == "in_hand" else A) @ Z
        if not T[2, 2] > 0.6:
            return None
        return project(BOARD.points, BOARD.radius, T, row), T

    while len(samples) < count:
        q = middle + rng.uniform(-spread, spread, len(names))
        v = rng.uniform(-1.0, 1.0, len(names)) * speed
        got = view(q - v * delay)
        if got is None or not ((got[0] > 16) & (got[0] < (623, 463))).all():
            continue
        pixels, T = got
        t = 10**9 * (1 + len(samples))
        track = tuple(
            (t + 10**7 * j, dict(zip(names, (q + v * 0.01 * j).tolist(), strict=True))) for j in range(-10, 11)
        )
        detection = BoardDetection(np.arange(len(BOARD.points)), pixels + rng.normal(0.0, px, pixels.shape), px)
        joints = {name: at - (zeros or {}).get(name, 0.0) for name, at in zip(names, q.tolist(), strict=True)}
        samples.add(Sample(f"s{len(samples) + 1:03d}", t, t, joints, speed, detection, T, b"", track if speed else ()))
    return Known(samples, X, description)
