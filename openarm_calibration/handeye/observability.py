# SPDX-License-Identifier: Apache-2.0
"""Whether poses determine the mounts, and if not, why and what to add.

Two checks: of the robot's motion before anything is solved (too few poses, no rotation, one axis), and of the
information matrix afterwards, scaled to 1 mm and 0.1°, whose smallest eigenvalue is the information on the worst
direction. Angles in rad.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from openarm_calibration.handeye.problem import Problem
from openarm_calibration.handeye.unknowns import Estimate, Noise
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

#: Most poses between which the motion is looked at.
_MOST = 100
#: Fewer can't determine twelve unknowns.
FEWEST = 3
#: Rotations below this can't be distinguished from the robot's own errors, rad.
_NO_ROTATION = math.radians(0.5)
_NO_SECOND_AXIS = math.radians(0.4)
_NO_TRANSLATION = 0.003  # m
#: Named as small or as near to one axis when a solution turns out too uncertain, rad.
_SMALL_ROTATION = math.radians(15.0)
_SMALL_SECOND_AXIS = math.radians(10.0)
_WORST_CONDITION = 1e12
#: No arm in order is off by so much from pose to pose, m and rad.
_BAD_ARM = (1.5e-3, math.radians(0.15))
#: Nor do the marks of a view share so many times their own spread.
_BAD_MISFIT = 3.0
#: Six columns of a mount in units of 1 mm and 0.1°.
UNITS = np.array([1e-3] * 3 + [math.radians(0.1)] * 3)


@dataclass(frozen=True, eq=False)
class PoseSpread:
    """How far the robot moved between its poses.

    Args:
        poses: Number of poses.
        rotation: Largest angle between two poses, rad.
        second: Largest angle between two poses about axes across the main one, rad.
        translation: Largest distance between two poses, m.
        axis: (3,) main rotation axis in the gripper's frame.
        least: Axis of the gripper about which it turned least.
    """

    poses: int
    rotation: float
    second: float
    translation: float
    axis: Array
    least: str

    @property
    def one_axis(self) -> bool:
        """Whether it turned about one axis only, and moved across it."""
        return self.rotation >= _NO_ROTATION and self.second < _NO_SECOND_AXIS


def motion(A: Array) -> PoseSpread:
    """Describe the motion of robot poses A (n, 4, 4)."""
    n = len(A)
    if n < 2:
        return PoseSpread(n, 0.0, 0.0, 0.0, np.array([0.0, 0.0, 1.0]), "x")
    A = A[np.unique(np.linspace(0, n - 1, min(n, _MOST)).astype(int))]
    first, second = np.triu_indices(len(A), 1)
    w = Rotation.from_matrix(np.swapaxes(A[first, :3, :3], 1, 2) @ A[second, :3, :3]).as_rotvec()
    axis = np.linalg.eigh(w.T @ w)[1][:, -1]
    across = np.linalg.norm(w - np.outer(w @ axis, axis), axis=1)
    apart = np.linalg.norm(A[:, None, :3, 3] - A[None, :, :3, 3], axis=-1)
    rotation = float(np.linalg.norm(w, axis=1).max())
    least = "xyz"[int(np.argmin(np.sum(w**2, axis=0)))]
    return PoseSpread(n, rotation, float(across.max()), float(apart.max()), axis, least)


def require_motion(problem: Problem) -> None:
    """Refuse views that can't determine the mounts, before anything is solved.

    Raises:
        OpenArmError: DEGENERATE, with the name of what is wrong and what to add.
    """
    if not (np.isfinite(problem.A).all() and np.isfinite(problem.pixels).all() and np.isfinite(problem.free).all()):
        raise OpenArmError(Code.INVALID_ARGUMENT, "a pose or a pixel is not a finite number; remove that sample")
    for camera in range(problem.cameras):
        mine = (problem.camera == camera) & (problem.kind < 2)
        if not mine.any():
            if (problem.camera == camera).any():
                continue  # tied by fixed views to a board that another camera sees
            raise OpenArmError(Code.DEGENERATE, "too few poses: a camera has no view at all; take samples with it")
        for board in np.unique(problem.board[mine]):
            chosen = mine & (problem.board == board)
            seen = motion(problem.A[chosen][np.unique(problem.pose[chosen], return_index=True)[1]])
            fault = motion_fault(seen)
            if fault:
                raise OpenArmError(Code.DEGENERATE, fault)


def motion_fault(seen: PoseSpread) -> str:
    """Return why a motion determines no mounts, and what to add; empty when it may."""
    degrees, millimetres = math.degrees(seen.rotation), seen.translation * 1e3
    if seen.poses < FEWEST:
        return (
            f"too few poses: {seen.poses}, at least {FEWEST} that differ in rotation are needed"
            " (10 to 15 for a good result)"
        )
    if seen.rotation < _NO_ROTATION and seen.translation < _NO_TRANSLATION:
        return (
            f"identical poses: the {seen.poses} poses are within {millimetres:.1f} mm and {degrees:.2f}°;"
            " move the arm between samples, with rotations of 30° or more"
        )
    if seen.rotation < _NO_ROTATION:
        return (
            f"pure translation: the {seen.poses} poses turn by {degrees:.2f}° at most, so the offset of the camera is"
            " not determined; rotate the hand by 30° or more about two different axes"
        )
    if seen.one_axis:
        return (
            f"one rotation axis: all rotations (up to {degrees:.0f}°) are about the gripper's {axis_name(seen.axis)};"
            f" rotate by 15° or more about a second axis, such as {_other(seen.axis)}"
        )
    return ""


def require_accuracy(problem: Problem, estimate: Estimate, most_translation: float, most_rotation: float) -> None:
    """Refuse an answer that is less certain than asked for.

    Args:
        problem: The views.
        estimate: Estimate whose information and covariance have the cameras' mounts first.
        most_translation: Largest standard deviation of a mount's position (of the vector), m.
        most_rotation: The same of its rotation, rad.

    Raises:
        OpenArmError: DEGENERATE, with the deviation, its cause, and what to add.
    """
    condition = condition_number(problem, estimate.information)
    if condition > _WORST_CONDITION:
        raise _degenerate(
            problem, motion(problem.A[problem.kind < 2]), estimate.noise,
            f"some direction of the mounts is not determined (condition {condition:.1e}, at most"
            f" {_WORST_CONDITION:.0e} is accepted)",
        )  # fmt: skip
    covariance = estimate.covariance()
    for camera in range(problem.cameras):
        variance = np.maximum(np.diag(covariance)[6 * camera : 6 * camera + 6], 0.0)
        t, r = math.sqrt(variance[:3].sum()), math.sqrt(variance[3:].sum())
        if t > most_translation or r > most_rotation:
            raise _degenerate(
                problem, motion(problem.A[(problem.camera == camera) & (problem.kind < 2)]), estimate.noise,
                f"the predicted error is {t * 1e3:.2g} mm and {math.degrees(r):.2g}°,"
                f" more than {most_translation * 1e3:g} mm or {math.degrees(most_rotation):g}°",
            )  # fmt: skip


def condition_number(problem: Problem, information: Array) -> float:
    """Return the condition number of the information on the mounts, in units of 1 mm and 0.1°; infinite if singular."""
    mounts = problem.cameras + problem.boards
    units = np.tile(UNITS, mounts)
    scaled = information[: 6 * mounts, : 6 * mounts] * np.outer(units, units)
    if not np.isfinite(scaled).all():
        return math.inf
    values = np.linalg.eigvalsh(scaled)
    return float(values[-1] / values[0]) if values[0] > 0.0 else math.inf


def _degenerate(problem: Problem, seen: PoseSpread, noise: Noise, what: str) -> OpenArmError:
    """Return the refusal of an answer: its cause, what is wrong with it, and what to do."""
    advice = "add poses, nearer to the board and with larger rotations"
    if seen.rotation < _SMALL_ROTATION:
        cause = f"rotations too small (up to {math.degrees(seen.rotation):.1f}°)"
        advice = "rotate the hand by 30° or more between samples, about two different axes"
    elif seen.second < _SMALL_SECOND_AXIS:
        across = math.degrees(seen.second)
        cause = f"nearly one rotation axis (up to {across:.1f}° across the gripper's {axis_name(seen.axis)})"
        advice = f"rotate by 15° or more about {_other(seen.axis)} too"
    elif seen.poses < 6:
        cause = f"too few poses ({seen.poses})"
    elif noise.translation > _BAD_ARM[0] or noise.rotation > _BAD_ARM[1] or noise.misfit > _BAD_MISFIT:
        cause = (
            f"{seen.poses} poses that contradict each other, as if the robot were off by"
            f" {noise.translation * 1e3:.1f} mm and {math.degrees(noise.rotation):.2f}°"
            + (f", and their marks by {noise.view_px:.1f} px" if noise.misfit > _BAD_MISFIT else "")
        )
        zeros = "the joint zeros (`openarm calibrate zeros`), " if problem.joints else ""
        advice = f"check {zeros}the intrinsics in camera_info, the size of the board, and that it did not move"
    else:
        cause = f"{seen.poses} poses that are too noisy or too far from the board"
    return OpenArmError(Code.DEGENERATE, f"{cause}: {what}; {advice}")


def axis_name(axis: Array) -> str:
    """Return the name of a direction (3,), such as `z axis`."""
    k = int(np.argmax(np.abs(axis)))
    if abs(axis[k]) > math.cos(math.radians(20.0)):
        return f"{'xyz'[k]} axis"
    return f"axis ({axis[0]:.2f}, {axis[1]:.2f}, {axis[2]:.2f})"


def _other(axis: Array) -> str:
    return f"its {'xyz'[int(np.argmin(np.abs(axis)))]} axis"
