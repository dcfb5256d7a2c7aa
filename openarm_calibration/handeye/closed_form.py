# SPDX-License-Identifier: Apache-2.0
"""Closed forms of the hand-eye problem: those of OpenCV 4 by name.

All take the robot's poses A = T_base_gripper and the poses C = T_camera_board of one camera and one board, and return
X and Z as `problem` defines them. Methods are known by name, never by OpenCV's numbers, which change between versions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from openarm_calibration.handeye.problem import Setup
from openarm_calibration.handeye.transforms import inverses
from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: AX = XB: the mount of the camera from relative motions.
HAND_EYE = ("TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS")
#: AX = ZB: both mounts at once.
ROBOT_WORLD = ("SHAH", "LI")
METHODS = (*HAND_EYE, *ROBOT_WORLD)
#: What a calibration may be of.
REFINED = "REFINED"
ALGORITHMS = (REFINED, *METHODS)


@dataclass(frozen=True, eq=False)
class Mounts:
    """A closed-form answer: (4, 4) each, see `problem`."""

    X: Array
    Z: Array


def require_opencv() -> None:
    """Refuse an OpenCV that has no hand-eye functions.

    Raises:
        OpenArmError: ENVIRONMENT, naming the version.
    """
    # the constants are there even where the functions are not
    if not (hasattr(cv2, "calibrateHandEye") and hasattr(cv2, "calibrateRobotWorldHandEye")):
        raise OpenArmError(
            Code.ENVIRONMENT,
            f"OpenCV {cv2.__version__} has no calibrateHandEye; install opencv-python-headless >= 4.13, < 5",
        )


def checked_algorithm(name: str) -> str:
    """Return the method's proper name.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the methods.
    """
    if name.upper() not in ALGORITHMS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no algorithm {name!r}; algorithms: {', '.join(ALGORITHMS)}")
    return name.upper()


def closed_form(method: str, setup: Setup, A: Array, C: Array) -> Mounts:
    """Solve with one of OpenCV's methods.

    Args:
        method: A name of `METHODS`, in any case.
        setup: in_hand or to_hand.
        A: (n, 4, 4) T_base_gripper.
        C: (n, 4, 4) T_camera_board.

    Raises:
        OpenArmError: INVALID_ARGUMENT, listing the methods; DEGENERATE, when the method has no finite answer.
    """
    name = method.upper()
    if name not in METHODS:
        raise OpenArmError(
            Code.INVALID_ARGUMENT, f"no method {method!r}; methods: {', '.join(METHODS)} (and REFINED, the refinement)"
        )
    require_opencv()
    B = inverses(A) if setup == "in_hand" else A
    solve: Callable[[str, Array, Array], Mounts] = _hand_eye if name in HAND_EYE else _robot_world
    try:
        mounts = solve(name, B, C)
    except (cv2.error, np.linalg.LinAlgError) as error:
        text = str(error).strip().splitlines()[-1]
        raise OpenArmError(Code.DEGENERATE, f"{name} has no answer for these {len(A)} poses: {text}") from error
    if not (_is_rigid(mounts.X) and _is_rigid(mounts.Z)):
        raise OpenArmError(Code.DEGENERATE, f"{name} has no finite answer for these {len(A)} poses")
    return mounts


def _hand_eye(name: str, B: Array, C: Array) -> Mounts:
    A = inverses(B)  # for the fixed camera OpenCV wants the robot's poses inverted, for the moving one as they are
    R, t = cv2.calibrateHandEye(
        list(A[:, :3, :3]),
        list(A[:, :3, 3]),
        list(C[:, :3, :3]),
        list(C[:, :3, 3]),
        method=getattr(cv2, f"CALIB_HAND_EYE_{name}"),  # by keyword: by position it is taken for an output
    )
    X = se3.make(R, np.ravel(t))
    return Mounts(X, mean_pose(A @ X @ C))


def _robot_world(name: str, B: Array, C: Array) -> Mounts:
    R_z, t_z, R_x, t_x = cv2.calibrateRobotWorldHandEye(
        list(C[:, :3, :3]),
        list(C[:, :3, 3]),
        list(B[:, :3, :3]),
        list(B[:, :3, 3]),
        method=getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name}"),
    )
    return Mounts(se3.inverse(se3.make(R_x, np.ravel(t_x))), se3.inverse(se3.make(R_z, np.ravel(t_z))))


def nearest_rotation(M: Array) -> Array:
    """Return the rotation (3, 3) nearest to a matrix."""
    U, _, Vt = np.linalg.svd(M)
    return U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt


def mean_pose(T: Array) -> Array:
    """Return the mean rotation and median translation of poses (n, 4, 4)."""
    return se3.make(nearest_rotation(T[:, :3, :3].sum(axis=0)), np.median(T[:, :3, 3], axis=0))


def _is_rigid(T: Array) -> bool:
    return bool(np.isfinite(T).all() and np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-4))
