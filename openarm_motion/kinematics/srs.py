# SPDX-License-Identifier: Apache-2.0
"""Closed-form inverse kinematics of an arm with a spherical shoulder, one elbow joint and a spherical wrist.

OpenArm is such an arm (both versions, either side); so are many others with seven joints. The geometry is read from
the URDF and checked: an arm that is not built so is refused here and solved numerically instead. The left arm needs no
law of its own; that it mirrors the right one is a test. Poses are `T_base_tool` (4, 4), angles rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.kinematics import srs_intervals, srs_kernels
from openarm_motion.kinematics.chain import ArmKinematics, IkSolution, digits

#: How far the axes may miss each other: a rounded rpy in the URDF costs 4e-6 m.
_MEET = 2e-5
_PERPENDICULAR = 1e-4
#: Limits of joints that turn without end, as the kernels take them: whole turns are left to their callers, rad.
_MANY_TURNS = 1e6
#: A wrist out of reach by less is brought into reach for a first guess, m.
_NEAR_REACH = 1e-3


@dataclass(frozen=True)
class SrsMiss:
    """Why a pose has no configuration within the limits.

    Attributes:
        too_far: Distance of the wrist beyond the reach of the arm, m; negative: too near by so much; else 0.
        nearest: (k, 7) of each branch the configuration that exceeds its limits the least, the best first; at the
            nearest pose within reach where the distance is the reason, and empty when that is far away.
    """

    too_far: float
    nearest: Array


class SrsArm:
    """Closed-form solver of one arm.

    Args:
        kinematics: The arm.

    Raises:
        OpenArmError: INVALID_ARGUMENT, saying in what the arm differs from such a one.
    """

    def __init__(self, kinematics: ArmKinematics) -> None:
        self.kinematics = kinematics
        self._geometry, self._tool = _read_geometry(kinematics)
        self._lower = np.maximum(kinematics.lower, -_MANY_TURNS)
        self._upper = np.minimum(kinematics.upper, _MANY_TURNS)
        self._verify()

    @property
    def shoulder(self) -> Array:
        """Centre of the shoulder (3,), base frame, m."""
        return self._geometry[7].copy()

    def solve(self, pose: Array, swivel: float, branch: int) -> Array | None:
        """Configuration of one branch, not limited; None when the wrist is too far from or too near to the shoulder."""
        q = np.empty(7)
        status = srs_kernels.solve(_c(pose), swivel, branch, self._geometry, self._tool, self._lower, self._upper, q)
        return q if status == 0 else None

    def sweep(self, pose: Array, swivels: Array, margin: float = 0.0) -> list[IkSolution]:
        """Configurations within the limits less `margin`: all at `swivels` (k,), and one in each interval between."""
        rows = srs_kernels.BRANCHES * (swivels.size + srs_intervals.MOST)
        found, at, branch = np.empty((rows, 7)), np.empty(rows), np.empty(rows, dtype=np.int64)
        lower, upper = self._lower + margin, self._upper - margin
        count, _ = srs_intervals.sweep(_c(pose), swivels, self._geometry, self._tool, lower, upper, found, at, branch)
        if count:
            return [IkSolution(*of) for of in zip(found[:count].copy(), at.tolist(), branch.tolist(), strict=False)]
        # what is left are intervals that are points
        best, at, least, status = self._nearest(pose, swivels, margin)
        if status:
            return []
        kept = np.flatnonzero(least <= srs_intervals.ROUNDING)
        return [IkSolution(np.clip(best[i], lower, upper), float(at[i]), int(i)) for i in kept]

    def miss(self, pose: Array, swivels: Array, margin: float = 0.0) -> SrsMiss:
        """What is in the way of a pose that `sweep` finds nothing for."""
        best, _, least, status = self._nearest(pose, swivels, margin)
        excess = 0.0
        if status:
            excess, outwards = self._distance_excess(pose)
            if abs(excess) > _NEAR_REACH:
                return SrsMiss(excess, np.empty((0, 7)))
            brought = pose.copy()
            brought[:3, 3] -= (excess + np.copysign(1e-9, excess)) * outwards
            best, _, least, _ = self._nearest(brought, swivels, margin)
        order = np.argsort(least)
        return SrsMiss(excess, best[order[np.isfinite(least[order])]])

    def follow(
        self, poses: Array, swivels: Array, start: IkSolution, margin: float, max_step: float
    ) -> tuple[Array, int, str]:
        """Configurations (m, 7) along poses (m, 4, 4) at swivel angles (m,), on the branch of `start`.

        Returns:
            The path, the index of the first pose that fails (m when none does), and why it fails.
        """
        path = np.empty((poses.shape[0], 7))
        index, status, joint = srs_kernels.follow(
            _c(poses),
            _c(swivels),
            _c(start.q),
            start.branch,
            self._geometry,
            self._tool,
            self._lower + margin,
            self._upper - margin,
            max_step,
            path,
        )
        why = ""
        if status in (srs_kernels.TOO_FAR, srs_kernels.TOO_NEAR):
            why = self.distance_text(self._distance_excess(poses[index])[0])
        elif status == srs_kernels.LIMIT:
            why = self.kinematics.outside(path[index], margin)
        elif status == srs_kernels.JUMP:
            step = abs(path[index, joint] - path[index - 1, joint])
            why = f"{self.kinematics.names[joint]} would jump by {step:.2f} rad between neighbouring points"
        return path, int(index), why

    def swivel(self, q: ArrayLike) -> float:
        """Swivel angle of a configuration (7,), rad."""
        return float(srs_kernels.swivel_of(_c(q), self._geometry))

    def classify(self, q: ArrayLike) -> IkSolution:
        """Swivel angle and branch of a configuration."""
        values = np.ascontiguousarray(q, dtype=np.float64)
        swivel = self.swivel(values)
        pose = self.kinematics.fk(values)
        best, least = 0, np.inf
        for branch in range(srs_kernels.BRANCHES):
            candidate = self.solve(pose, swivel, branch)
            if candidate is None:
                continue
            distance = float(np.max(np.abs(nearest_turns(candidate, values, np.inf) - values)))
            if distance < least:
                best, least = branch, distance
        return IkSolution(values, swivel, best)

    def distance_text(self, excess: float) -> str:
        """Sentence about a wrist that is too far away (`excess` > 0, m) or too near (< 0)."""
        longest, shortest = self._reach()
        if excess >= 0.0:
            return (
                f"the wrist would be {longest + excess:.3f} m from the shoulder, the arm reaches {longest:.3f} m"
                f" ({digits(excess * 1e3)} mm short)"
            )
        return (
            f"the wrist would be {shortest + excess:.3f} m from the shoulder, the arm folds to {shortest:.3f} m"
            f" ({digits(-excess * 1e3)} mm too near)"
        )

    def _reach(self) -> tuple[float, float]:
        upper, fore = (float(np.linalg.norm(self._geometry[i])) for i in (8, 9))
        return upper + fore, abs(upper - fore)

    def _nearest(self, pose: Array, swivels: Array, margin: float) -> tuple[Array, Array, Array, int]:
        """What `srs_intervals.nearest` fills and returns."""
        best, at, least = np.empty((8, 7)), np.empty(8), np.empty(8)
        lower, upper = self._lower + margin, self._upper - margin
        status = srs_intervals.nearest(_c(pose), swivels, self._geometry, self._tool, lower, upper, best, at, least)
        return best, at, least, int(status)

    def _distance_excess(self, pose: Array) -> tuple[float, Array]:
        """How much too far (> 0) or too near (< 0) the wrist would be, m, and the direction (3,) out to it."""
        out = pose[:3, 3] - pose[:3, :3] @ self._tool.T @ self._geometry[10] - self._geometry[7]
        distance = float(np.linalg.norm(out))
        longest, shortest = self._reach()
        nearer = longest if distance > 0.5 * (shortest + longest) else shortest
        return distance - nearer, out / max(distance, 1e-12)

    def _verify(self) -> None:
        """Solve a few poses and compare with forward kinematics: a wrong assumption must not pass as a wrong grasp."""
        rng = np.random.default_rng(0)
        for _ in range(8):
            q = rng.uniform(*self.kinematics.span)
            pose = self.kinematics.fk(q)
            solution = self.solve(pose, self.swivel(q), self.classify(q).branch)
            error = np.inf if solution is None else float(np.max(np.abs(self.kinematics.fk(solution) - pose)))
            if error > 5.0 * _MEET:
                raise OpenArmError(Code.INVALID_ARGUMENT, f"closed form misses forward kinematics by {error:.2g}")


def _read_geometry(kinematics: ArmKinematics) -> tuple[Array, Array]:
    """Rows of `geometry` and `tool` as `srs_kernels` takes them, from the arm at zero.

    Raises:
        OpenArmError: INVALID_ARGUMENT, saying what does not fit.
    """
    if kinematics.n != 7 or bool(kinematics.prismatic.any()):
        raise _not_srs(
            f"it has {kinematics.n} joints, {int(kinematics.prismatic.sum())} of them prismatic, expected 7 turning"
        )
    origins, axes = kinematics.joint_axes(np.zeros(7))
    pose = kinematics.fk(np.zeros(7))
    shoulder = _meet(origins[:3], axes[:3], "the shoulder (joints 1 to 3)")
    wrist = _meet(origins[4:], axes[4:], "the wrist (joints 5 to 7)")
    for i, j in ((0, 1), (1, 2), (4, 5), (5, 6)):
        if abs(float(axes[i] @ axes[j])) > _PERPENDICULAR:
            raise _not_srs(f"axes {i + 1} and {j + 1} are not perpendicular")
    w4 = axes[3]
    elbow = origins[3] + w4 * float(w4 @ (shoulder - origins[3]))
    if abs(float(w4 @ (wrist - elbow))) > _MEET:
        raise _not_srs("the wrist centre does not turn in the plane of the shoulder centre about joint 4")
    upper, fore = elbow - shoulder, wrist - elbow
    if min(float(np.linalg.norm(upper)), float(np.linalg.norm(fore))) < 1e-3:
        raise _not_srs("the elbow axis goes through the shoulder or the wrist centre")
    middle = kinematics.middle[3]
    K = np.cross(np.eye(3), w4).T
    turned = fore + np.sin(middle) * K @ fore + (1.0 - np.cos(middle)) * K @ K @ fore
    bend = float(np.sign(upper @ np.cross(w4, upper + turned))) or 1.0
    geometry = np.vstack([axes, shoulder, upper, fore, pose[:3, 3] - wrist, [bend, 0.0, 0.0]])
    return np.ascontiguousarray(geometry), np.ascontiguousarray(pose[:3, :3])


def _meet(origins: Array, axes: Array, what: str) -> Array:
    """Point where lines meet, least squares; refuses lines that miss it."""
    P = np.eye(3)[None] - axes[:, :, None] * axes[:, None, :]
    point: Array = np.linalg.lstsq(P.reshape(-1, 3), (P @ origins[:, :, None]).reshape(-1), rcond=None)[0].astype(
        np.float64
    )
    miss = float(np.max(np.linalg.norm(np.einsum("kij,kj->ki", P, point - origins), axis=1)))
    if miss > _MEET:
        raise _not_srs(f"the axes of {what} miss a common point by {miss * 1e3:.3g} mm")
    return point


def _not_srs(why: str) -> OpenArmError:
    return OpenArmError(Code.INVALID_ARGUMENT, f"not a spherical-revolute-spherical arm: {why}")


def _c(values: ArrayLike) -> Array:
    return np.ascontiguousarray(values, dtype=np.float64)
