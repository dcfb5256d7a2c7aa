# SPDX-License-Identifier: Apache-2.0
"""How a file writes poses: form of the rotation, unit of lengths, and which of two frames is in the other.

What is not said is found by trying: a wrong convention leaves poses of robot and board that no mounts explain. What
can't be found so: a camera on the hand with inverted poses gives the same equations as a fixed one with poses as they
are, so that the kind of the camera must be known.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.closed_form import closed_form
from openarm_calibration.handeye.pose_pairs import PosePairs, residuals
from openarm_calibration.handeye.problem import Setup, inverses
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

RotationForm = Literal["xyzw", "wxyz", "rotvec", "rotvec_deg", "rpy", "rpy_deg", "abc_deg", "matrix"]
ROTATIONS: tuple[RotationForm, ...] = get_args(RotationForm)
#: What each form is, for tables and errors.
MEANING: dict[RotationForm, str] = {
    "xyzw": "quaternion x y z w", "wxyz": "quaternion w x y z", "rotvec": "rotation vector, rad",
    "rotvec_deg": "rotation vector, degrees", "rpy": "roll pitch yaw about fixed axes (URDF), rad",
    "rpy_deg": "roll pitch yaw about fixed axes (URDF), degrees", "abc_deg": "A B C about z y' x'' (KUKA), degrees",
    "matrix": "3x4 or 4x4 matrix by rows",
}  # fmt: skip
#: Numbers of a pose by the form of its rotation.
_COUNT: dict[int, tuple[RotationForm, ...]] = {
    7: ("xyzw", "wxyz"), 6: ("rotvec", "rotvec_deg", "rpy", "rpy_deg", "abc_deg"), 12: ("matrix",), 16: ("matrix",),
}  # fmt: skip
Unit = Literal["m", "mm"]
Frames = Literal["T_base_tip", "T_tip_base"]
#: A quaternion may be off one by this, a matrix off a rotation.
_LOOSE = 0.02
#: A second convention that explains the poses to within this factor leaves the guess open.
_AMBIGUOUS = 1.5
#: Largest positions of a robot's tip: above these metres the numbers are millimetres, below these millimetres metres.
_REACH, _CRAMPED = 20.0, 5.0


@dataclass(frozen=True)
class Convention:
    """How poses are written."""

    rotation: RotationForm
    unit: Unit
    frames: Frames

    @property
    def text(self) -> str:
        """In words."""
        return f"{self.frames}, {MEANING[self.rotation]}, {self.unit}"

    def poses(self, rows: Array) -> Array | None:
        """Return T_base_tip (n, 4, 4) of rows (n, k) of numbers: position, then rotation; None when they are none."""
        position, R = _read(self.rotation, rows)
        if R is None:
            return None
        T = np.tile(np.eye(4), (len(rows), 1, 1))
        T[:, :3, :3], T[:, :3, 3] = R, position * (1e-3 if self.unit == "mm" else 1.0)
        return inverses(T) if self.frames == "T_tip_base" else T


@dataclass(frozen=True)
class Tried:
    """A convention, and what a closed form leaves of the poses: rms by axis, m at the board and rad."""

    convention: Convention
    translation: float
    rotation: float

    @property
    def score(self) -> float:
        """Smaller is better; a factor in either counts the same."""
        return math.sqrt(max(self.translation, 1e-6) * max(self.rotation, 1e-6))


def _read(form: RotationForm, rows: Array) -> tuple[Array, Array | None]:
    """Return positions (n, 3) and rotations (n, 3, 3); None for numbers that are no rotations."""
    if form == "matrix":
        M = rows[:, :12].reshape(-1, 3, 4)
        off = np.abs(M[:, :, :3] @ np.swapaxes(M[:, :, :3], 1, 2) - np.eye(3)).max()
        last_is_wrong = rows.shape[1] == 16 and not np.allclose(rows[:, 12:], (0.0, 0.0, 0.0, 1.0), atol=1e-6)
        if off > _LOOSE or last_is_wrong or (np.linalg.det(M[:, :, :3]) < 0.0).any():
            return M[:, :, 3], None
        return M[:, :, 3], Rotation.from_matrix(M[:, :, :3]).as_matrix()
    position, numbers = rows[:, :3], rows[:, 3:]
    if form in ("xyzw", "wxyz"):
        if np.abs(np.linalg.norm(numbers, axis=1) - 1.0).max() > _LOOSE:
            return position, None
        return position, Rotation.from_quat(numbers, scalar_first=form == "wxyz").as_matrix()
    degrees = form.endswith("_deg")
    if not degrees and np.abs(numbers).max() > 3.0 * math.pi:
        return position, None
    angles = np.radians(numbers) if degrees else numbers
    if form.startswith("rotvec"):
        return position, Rotation.from_rotvec(angles).as_matrix()
    return position, Rotation.from_euler("xyz" if form.startswith("rpy") else "ZYX", angles).as_matrix()


def candidates(
    rows: Array, rotation: RotationForm | None, unit: Unit | None, frames: Frames | None
) -> tuple[Convention, ...]:
    """Return the conventions that numbers (n, k) may have, with what is given.

    Args:
        rows: (n, k) numbers of poses.
        rotation: Given form, or None.
        unit: Given unit, or None.
        frames: Given direction, or None.

    Raises:
        OpenArmError: CONFIG_INVALID, when the numbers are no poses.
    """
    forms = _COUNT.get(rows.shape[1], ())
    if not forms or (rotation is not None and rotation not in forms):
        by_count = "; ".join(f"{count}: {', '.join(names)}" for count, names in _COUNT.items())
        what = f"{rotation} with " if rotation else ""
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{what}{rows.shape[1]} numbers a pose; expected one of these counts, {by_count}"
        )
    chosen = (rotation,) if rotation else forms
    far = float(np.abs(_read(chosen[0], rows)[0]).max())
    likely: tuple[Unit, ...] = ("mm",) if far > _REACH else ("m",) if far < _CRAMPED else ("m", "mm")
    units: tuple[Unit, ...] = (unit,) if unit else likely
    ways: tuple[Frames, ...] = (frames,) if frames else ("T_base_tip", "T_tip_base")
    made = tuple(Convention(*one) for one in itertools.product(chosen, units, ways))
    fitting = tuple(one for one in made if one.poses(rows) is not None)
    if not fitting:
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"the numbers are no rotations as {' or '.join(MEANING[form] for form in chosen)}; is the order of columns"
            " position, then rotation?",
        )
    return fitting


def guess(rows: Array, C: Array, setup: Setup, choices: tuple[Convention, ...]) -> tuple[Tried, ...]:
    """Try conventions of the robot's poses against the poses of the board; the best first.

    Args:
        rows: (n, k) numbers of the robot's poses.
        C: (n, 4, 4) T_camera_board.
        setup: in_hand or to_hand.
        choices: Conventions to try.

    Raises:
        OpenArmError: DEGENERATE, when no closed form has an answer.
    """
    tried: list[Tried] = []
    names = tuple(str(k) for k in range(len(rows)))
    for choice in choices:
        A = choice.poses(rows)
        if A is None:
            continue
        pairs = PosePairs(setup, A, C, names)
        best = math.inf, math.inf
        for method in ("PARK", "SHAH"):
            try:
                mounts = closed_form(method, setup, A, C)
                left = residuals(pairs, mounts.X, mounts.Z)
            except (OpenArmError, ValueError, np.linalg.LinAlgError):  # such as a reflection
                continue
            rms = np.sqrt(np.median(left**2, axis=0) / 0.4549)
            found = float(np.sqrt(np.mean(rms[:3] ** 2))), float(np.sqrt(np.mean(rms[3:] ** 2)))
            best = min(best, found, key=lambda one: one[0] * one[1])
        if math.isfinite(best[0]):
            tried.append(Tried(choice, *best))
    if not tried:
        raise OpenArmError(Code.DEGENERATE, f"no convention of poses gives an answer for these {len(rows)} samples")
    return tuple(sorted(tried, key=lambda one: one.score))


def is_ambiguous(tried: tuple[Tried, ...]) -> bool:
    """Return whether the second best convention explains the poses about as well as the best."""
    return len(tried) > 1 and tried[1].score < _AMBIGUOUS * tried[0].score


def table(tried: tuple[Tried, ...]) -> str:
    """Return lines for a terminal."""
    lines = ["conventions of the robot's poses, by what a closed form leaves of them"]
    for one in tried:
        left = f"{one.translation * 1e3:10.2f} mm {math.degrees(one.rotation):9.3f}°"
        lines.append(f"  {left}  {one.convention.text}")
    return "\n".join(lines)
