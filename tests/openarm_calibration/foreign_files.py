# SPDX-License-Identifier: Apache-2.0
"""Files as other tools write them, of known mounts: by their documented formats, from numbers made here."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from openarm_calibration.board.board import Board
from openarm_calibration.handeye.pose_pairs import PosePairs
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.types import Array
from tests.openarm_calibration import known_session

K = Intrinsics.from_fovy(640, 480, 60.0)


@dataclass(frozen=True, eq=False)
class Truth:
    """Poses of a robot and of a board in a camera, and the mounts."""

    setup: Literal["in_hand", "to_hand"]
    X: Array
    Z: Array
    A: Array
    C: Array

    @property
    def pairs(self) -> PosePairs:
        return PosePairs(self.setup, self.A, self.C, tuple(f"s{k + 1:03d}" for k in range(len(self.A))))


def truth(
    setup: Literal["in_hand", "to_hand"],
    count: int = 14,
    translation: float = 0.0,
    rotation: float = 0.0,
    seed: int = 0,
) -> Truth:
    """Return poses that show the board to the camera; noise on the board's poses by axis, m and rad."""
    rng = np.random.default_rng(seed)
    X = se3.make(se3.exp_so3(rng.normal(0.0, 0.7, 3)), rng.uniform(-0.08, 0.08, 3))
    Z = se3.make(se3.exp_so3(rng.normal(0.0, 0.7, 3)), rng.uniform(0.2, 0.5, 3))
    A, C = [], []
    for _ in range(count):
        turn = se3.exp_so3((*rng.normal(0.0, 0.25, 2), 0.0)) @ se3.rot_z(rng.uniform(-0.8, 0.8))
        seen = se3.make(turn, (*rng.uniform(-0.05, 0.05, 2), rng.uniform(0.36, 0.55)))
        B = X @ seen @ se3.inverse(Z)
        A.append(se3.inverse(B) if setup == "in_hand" else B)
        off = se3.make(se3.exp_so3(rng.normal(0.0, rotation, 3)), rng.normal(0.0, translation, 3))
        C.append(se3.make(seen[:3, :3] @ off[:3, :3], seen[:3, 3] + off[:3, 3]))
    return Truth(setup, X, Z, np.array(A), np.array(C))


def _message(T: Array, indent: str) -> str:
    x, y, z, w = se3.quat_xyzw_from_matrix(T[:3, :3])
    lines = ["translation:", *(f"  {n}: {float(v)!r}" for n, v in zip("xyz", T[:3, 3], strict=True)), "rotation:"]
    lines += [f"  {n}: {float(v)!r}" for n, v in zip("xyzw", (x, y, z, w), strict=True)]
    return "".join(f"{indent}{line}\n" for line in lines)


def easy_handeye2(path: Path, known: Truth, kind: str = "") -> Path:
    """Write a SampleList as rosidl_runtime_py.message_to_yaml does; the sampler leaves the parameters empty."""
    text = f"parameters:\n  name: ''\n  calibration_type: '{kind}'\n  robot_base_frame: ''\n"
    text += "  robot_effector_frame: ''\n  tracking_base_frame: ''\n  tracking_marker_frame: ''\n"
    text += "  freehand_robot_movement: false\n  move_group_namespace: /\n  move_group: manipulator\nsamples:\n"
    for A, C in zip(known.A, known.C, strict=True):
        robot = A if known.setup == "in_hand" else se3.inverse(A)  # looked up from the effector there
        text += f"- robot:\n{_message(robot, '    ')}  tracking:\n{_message(C, '    ')}"
    path.write_text(text)
    return path


def moveit_yaml(path: Path, known: Truth) -> Path:
    """Write what the RViz panel of moveit_calibration saves: 16 numbers by rows, in the block style of yaml-cpp."""
    text = ""
    for A, C in zip(known.A, known.C, strict=True):
        for key, T, mark in (("effector_wrt_world", A, "- "), ("object_wrt_sensor", C, "  ")):
            text += f"{mark}{key}:\n" + "".join(f"    - {value:.9g}\n" for value in T.ravel())
    path.write_text(text)
    return path


def moveit_json(path: Path, known: Truth) -> Path:
    """Write the pairs of 4x4 matrices of its solver's tests."""
    path.write_text(json.dumps([[A.tolist(), C.tolist()] for A, C in zip(known.A, known.C, strict=True)]))
    return path


def numbers(A: Array, rotation: str, unit: str = "m", frames: str = "T_base_tip") -> Array:
    """Return the rows (n, k) of poses as a table has them, by scipy's conversions."""
    T = A if frames in ("T_base_tip", "T_camera_board") else np.linalg.inv(A)
    R, p = Rotation.from_matrix(T[:, :3, :3]), T[:, :3, 3] * (1000.0 if unit == "mm" else 1.0)
    if rotation in ("matrix", "columns"):
        M = T.copy()
        M[:, :3, 3] = p
        return (M if rotation == "matrix" else M.swapaxes(1, 2)).reshape(-1, 16)
    name, degrees = rotation.removesuffix("_deg"), rotation.endswith("_deg")
    if name == "rotvec":
        return np.hstack([p, R.as_rotvec(degrees=degrees)])
    if name in ("xyzw", "wxyz"):
        return np.hstack([p, R.as_quat(scalar_first=name == "wxyz")])
    return np.hstack([p, R.as_euler(name, degrees=degrees)])


def table(path: Path, rows: Array, names: list[str] | None = None, header: str = "") -> Path:
    """Write a CSV; names of images come first in a line."""
    lines = [header] if header else []
    for k, row in enumerate(rows):
        cells = [f"{value:.9g}" for value in row]
        lines.append(", ".join([names[k], *cells] if names else cells))
    path.write_text("\n".join(lines) + "\n")
    return path


def distorted(image: Array, lens: Array, border: float = 130.0) -> Array:
    """Return a picture as a lens with these coefficients of OpenCV shows it."""
    at = _undistorted(image.shape, tuple(lens))
    return cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderValue=(border,))


@cache
def _undistorted(shape: tuple[int, int], lens: tuple[float, ...]) -> Array:
    """Where each pixel of a picture is in that of a pinhole camera."""
    u, v = np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0])))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 100, 1e-10)
    rays = cv2.undistortPointsIter(pixels, K.matrix, np.array(lens), np.eye(3), K.matrix, stop)
    return rays.reshape(*shape, 2).astype(np.float32)


def pictures(folder: Path, known: Truth, board: Board, lens: Array | None = None) -> list[str]:
    """Write a PNG of each pose; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = []
    for k, C in enumerate(known.C):
        picture = known_session.photograph(board, C, K)
        picture = picture if lens is None else distorted(picture, lens)
        names.append(f"view_{k + 1}.png")
        cv2.imwrite(str(folder / names[-1]), np.clip(np.rint(picture), 0, 255).astype(np.uint8))
    return names
