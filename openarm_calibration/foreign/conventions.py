# SPDX-License-Identifier: Apache-2.0
"""How a file writes poses: form of the rotation, unit of lengths, and which of two frames is in the other."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.transforms import inverses
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

_ORDERS = tuple("".join(one) for one in itertools.product("XYZ", repeat=3) if one[0] != one[1] != one[2])
#: Euler angles as in scipy: capitals turn about moving axes, small letters about fixed ones.
EULER = tuple(order for upper in _ORDERS for order in (upper, upper.lower()))
_OF_THREE = tuple(f"{name}{unit}" for name in ("rotvec", *EULER) for unit in ("", "_deg"))
#: Forms of a rotation by the numbers of a pose: position and rotation, or a matrix.
FORMS: dict[int, tuple[str, ...]] = {
    6: _OF_THREE, 7: ("xyzw", "wxyz"), 12: ("matrix", "columns"), 16: ("matrix", "columns"),
}  # fmt: skip
#: Other names of forms: URDF's, and KUKA's.
ALIASES = {"rpy": "xyz", "abc": "ZYX", "rpy_deg": "xyz_deg", "abc_deg": "ZYX_deg"}
_MEANING = {
    "xyzw": "quaternion x y z w", "wxyz": "quaternion w x y z", "rotvec": "rotation vector",
    "matrix": "matrix by rows", "columns": "matrix by columns",
}  # fmt: skip
Unit = Literal["m", "cm", "mm", "inch"]
UNITS: dict[Unit, float] = {"m": 1.0, "cm": 0.01, "mm": 0.001, "inch": 0.0254}
#: A quaternion may be off one by this, a matrix off a rotation.
_LOOSE = 0.02
#: No pose has a larger number: ten kilometres in mm.
_WILD = 1e7


@dataclass(frozen=True)
class Convention:
    """How poses are written.

    Args:
        rotation: A name of `FORMS`.
        unit: Unit of positions.
        frames: "T_base_tip" of a robot, "T_camera_board" of a board.
        inverse: Whether they are the other way round.
    """

    rotation: str
    unit: Unit = "m"
    frames: str = "T_base_tip"
    inverse: bool = False

    @property
    def direction(self) -> str:
        """Of which frame in which the poses are."""
        return inverted(self.frames) if self.inverse else self.frames

    @property
    def text(self) -> str:
        """In words."""
        return f"{self.direction}, {meaning(self.rotation)}, {self.unit}"

    def poses(self, rows: Array) -> Array | None:
        """Return poses (n, 4, 4) in `frames`, m, of rows (n, k) of numbers; None when they are none."""
        found = read(self.rotation, rows)
        if found is None:
            return None
        T = found.copy()
        T[:, :3, 3] *= UNITS[self.unit]
        return inverses(T) if self.inverse else T


def inverted(frames: str) -> str:
    """Return the name of the inverse of a transform `T_a_b`."""
    _, a, b = frames.split("_")
    return f"T_{b}_{a}"


def meaning(form: str) -> str:
    """Return a form of a rotation in words."""
    if form in _MEANING:
        return _MEANING[form]
    name, degrees = form.removesuffix("_deg"), form.endswith("_deg")
    if name == "rotvec":
        return f"rotation vector, {'degrees' if degrees else 'rad'}"
    also = {"xyz": " (roll pitch yaw of URDF)", "ZYX": " (A B C of KUKA)"}.get(name, "")
    axes = "moving" if name.isupper() else "fixed"
    return f"angles {name} about {axes} axes{also}, {'degrees' if degrees else 'rad'}"


def checked_form(name: str) -> str:
    """Return the name of a form of rotations.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the forms.
    """
    form = ALIASES.get(name, name)
    if form not in {one for forms in FORMS.values() for one in forms}:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"no rotation {name!r}; expected xyzw, wxyz, matrix, columns, rotvec, rpy, abc, or three axes: XYZ, ZYZ,"
            " ... about moving axes, xyz, zyz, ... about fixed ones; with _deg for degrees",
        )
    return form


def read(form: str, rows: Array) -> Array | None:
    """Return poses (n, 4, 4) of rows (n, k), in the unit of the rows; None for numbers that are no rotations."""
    if form not in FORMS.get(rows.shape[1], ()):
        return None
    if form in ("matrix", "columns"):
        return _of_matrices(rows, by_columns=form == "columns")
    numbers, degrees = rows[:, 3:], form.endswith("_deg")
    if form in ("xyzw", "wxyz"):
        if np.abs(np.linalg.norm(numbers, axis=1) - 1.0).max() > _LOOSE:
            return None
        R = Rotation.from_quat(numbers, scalar_first=form == "wxyz")
    elif not degrees and np.abs(numbers).max() > 3.0 * np.pi:
        return None
    else:
        angles = np.radians(numbers) if degrees else numbers
        name = form.removesuffix("_deg")
        R = Rotation.from_rotvec(angles) if name == "rotvec" else Rotation.from_euler(name, angles)
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = R.as_matrix(), rows[:, :3]
    return T


def _of_matrices(rows: Array, by_columns: bool) -> Array | None:
    wide = rows.shape[1] // 4
    M = rows.reshape(-1, 4, wide).swapaxes(1, 2) if by_columns else rows.reshape(-1, wide, 4)
    R = M[:, :3, :3]
    whole = wide == 3 or np.allclose(M[:, 3], (0.0, 0.0, 0.0, 1.0), atol=1e-6)
    if not whole or np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() > _LOOSE or (np.linalg.det(R) < 0.0).any():
        return None
    T = np.tile(np.eye(4), (len(rows), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = Rotation.from_matrix(R).as_matrix(), M[:, :3, 3]
    return T


def _mirrored(rows: Array, form: str) -> bool:
    """Return whether all matrices of rows (n, k) would be rotations but for a mirror."""
    if form not in ("matrix", "columns"):
        return False
    wide = rows.shape[1] // 4
    M = rows.reshape(-1, 4, wide).swapaxes(1, 2) if form == "columns" else rows.reshape(-1, wide, 4)
    R = M[:, :3, :3]
    return bool(np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max() < _LOOSE and (np.linalg.det(R) < 0.0).all())


def readings(rows: Array, frames: str, names: Sequence[str] = ()) -> tuple[Convention, ...]:
    """Return the forms that rotations of rows (n, k) may have, each once where several give the same rotations.

    Args:
        rows: (n, k) numbers of poses.
        frames: Name of the transform, such as T_base_tip.
        names: (n,) of the records, for the error.

    Raises:
        OpenArmError: CONFIG_INVALID, when the numbers are no poses.
    """
    every = FORMS.get(rows.shape[1], ())
    if not every:
        by_count = "; ".join(f"{count}: {', '.join(names[:6])}" for count, names in FORMS.items())
        raise OpenArmError(
            Code.CONFIG_INVALID, f"{rows.shape[1]} numbers a pose; expected one of these counts, {by_count}"
        )
    if (wild := np.abs(rows).max(axis=1) > _WILD).any():
        k = int(np.argmax(wild))
        where = names[k] if len(names) == len(rows) else f"pose {k + 1}"
        raise OpenArmError(Code.CONFIG_INVALID, f"{where} has the number {np.abs(rows[k]).max():g}, which no pose has")
    out: list[Convention] = []
    seen: list[Array] = []
    for form in every:
        T = read(form, rows)
        if T is not None and not any(np.abs(T - other).max() < 1e-9 for other in seen):
            seen.append(T)
            out.append(Convention(form, frames=frames))
    if not out:
        wrong = {form: [k for k in range(len(rows)) if read(form, rows[k : k + 1]) is None] for form in every}
        form = min(every, key=lambda one: len(wrong[one]))
        if len(names) == len(rows) > len(wrong[form]):
            raise OpenArmError(
                Code.CONFIG_INVALID, f"{names[wrong[form][0]]} is no rotation as {meaning(form)}; the others are"
            )
        if any(_mirrored(rows, form) for form in every):
            raise OpenArmError(
                Code.CONFIG_INVALID,
                "the matrices are left-handed (determinant -1): one axis is the other way round; turn it back",
            )
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"the numbers are no rotations as {' or '.join(meaning(one) for one in every[:4])}; is the order of"
            " columns position, then rotation? Give --columns",
        )
    return tuple(out)
