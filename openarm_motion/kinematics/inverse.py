# SPDX-License-Identifier: Apache-2.0
"""All configurations at a tool pose, and one followed along a path: closed form where the arm allows it, else numeric.

The rest of the package asks only here, so an arm of any build behaves the same, if more slowly. Poses are `T_base_tool`
(4, 4) in the description's root frame; angles rad, lengths m.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import OpenArmError
from openarm_common.types import Array
from openarm_motion.kinematics.chain import ArmKinematics, IkResult, Solution
from openarm_motion.kinematics.srs import SrsArm, SrsMiss

#: Numeric solutions nearer to each other than this in every joint count as one.
_SAME = 0.05
_GUESSES = 24


class InverseKinematics:
    """Inverse kinematics of one arm.

    Args:
        kinematics: The arm.
        swivels: How many swivel angles of a whole turn are tried.
    """

    def __init__(self, kinematics: ArmKinematics, swivels: int = 48) -> None:
        self.kinematics = kinematics
        self._swivels = np.linspace(-np.pi, np.pi, swivels, endpoint=False)
        try:
            self._closed: SrsArm | None = SrsArm(kinematics)
            self.method = "closed form"
        except OpenArmError as error:
            self._closed = None
            self.method = f"numeric ({error.message})"

    def solutions(self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None) -> list[Solution]:
        """Configurations at a pose within the limits less `margin`.

        Args:
            pose: (4, 4).
            margin: Kept from the limits, rad.
            near: (n,) A first guess where solving is numeric, and one more swivel angle to try where it is not.
        """
        if self._closed is not None:
            swivels = self._swivels
            if near is not None:
                swivels = np.concatenate([[self._closed.classify(near).swivel], swivels])
            return self._closed.sweep(pose, swivels, margin)[0]
        return self._numeric(pose, margin, near, position_only=False)

    def position_solutions(self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None) -> list[Solution]:
        """Configurations whose tool origin is at the position of `pose`, in whatever orientation."""
        return [self.classify(s.q) for s in self._numeric(pose, margin, near, position_only=True)]

    def nearest(
        self, pose: Array, seed: ArrayLike | None = None, *, position_only: bool = False, margin: float = 0.0
    ) -> IkResult:
        """Numeric solution from one guess: near to it when there is one, and the nearest pose when there is none."""
        return self.kinematics.ik(pose, seed, position_only=position_only, margin=margin)

    def classify(self, q: ArrayLike) -> Solution:
        """Swivel angle and branch of a configuration."""
        values = np.asarray(q, dtype=np.float64)
        return Solution(values) if self._closed is None else self._closed.classify(values)

    def why_not(
        self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None, *, position_only: bool = False
    ) -> str:
        """Sentences about why a pose has no configuration: what binds, and what `nearest` finds with that guess."""
        reasons: list[str] = []
        if self._closed is not None and not position_only:
            reasons.append(self._binding(self._closed.sweep(pose, self._swivels, margin)[1], self._closed, margin))
        best = self.nearest(pose, near, position_only=position_only, margin=margin)
        p = ", ".join(f"{x:.3f}" for x in self.kinematics.fk(best.q)[:3, 3])
        turn = "" if position_only else f" and {math.degrees(best.orientation_error):.0f}°"
        reasons.append(f"the nearest reachable pose is {best.position_error * 1e3:.0f} mm{turn} away, at ({p}) m")
        return "; ".join(reason for reason in reasons if reason)

    def follow(
        self, poses: Array, start: Solution, margin: float, max_step: float, swivel_change: float = 0.0
    ) -> tuple[Array, int, str]:
        """Configurations along a path of poses (m, 4, 4), on the branch of `start`.

        Args:
            poses: The first is that of `start`.
            start: Configuration to start from.
            margin: Kept from the joint limits, rad.
            max_step: Greatest change of a joint between neighbouring poses, rad.
            swivel_change: How far the elbow swivels along the path, rad; has no meaning for a numeric arm.

        Returns:
            The path (m, n), the index of the first pose that fails (m when none does), and why it fails.
        """
        if self._closed is not None:
            swivels = start.swivel + swivel_change * np.linspace(0.0, 1.0, poses.shape[0])
            return self._closed.follow(poses, swivels, start.branch, margin, max_step)
        path = np.empty((poses.shape[0], self.kinematics.n))
        q = start.q
        for k, pose in enumerate(poses):
            result = self.kinematics.ik(pose, q, margin=margin, restarts=0)
            path[k] = result.q
            if not result.success:
                return path, k, f"no configuration on this branch: {result.position_error * 1e3:.1f} mm off the line"
            step = np.abs(result.q - q)
            if k > 0 and float(step.max()) > max_step:
                name = self.kinematics.names[int(step.argmax())]
                return path, k, f"{name} would jump by {step.max():.2f} rad between neighbouring points"
            q = result.q
        return path, poses.shape[0], ""

    def _numeric(self, pose: Array, margin: float, near: ArrayLike | None, *, position_only: bool) -> list[Solution]:
        rng = np.random.default_rng(0)
        arm = self.kinematics
        seeds = [] if near is None else [np.asarray(near, dtype=np.float64)]
        seeds += [0.5 * (arm.lower + arm.upper), *rng.uniform(arm.lower, arm.upper, (_GUESSES, arm.n))]
        found: list[Solution] = []
        for seed in seeds:
            result = arm.ik(pose, seed, position_only=position_only, margin=margin, restarts=0)
            if result.success and all(float(np.max(np.abs(result.q - s.q))) > _SAME for s in found):
                found.append(Solution(result.q))
        if not found:
            result = arm.ik(pose, near, position_only=position_only, margin=margin)
            found = [Solution(result.q)] if result.success else []
        return found

    def _binding(self, miss: SrsMiss, closed: SrsArm, margin: float) -> str:
        if miss.too_far:
            return closed.distance_text(miss.too_far)
        return "at best " + self.kinematics.outside(miss.nearest, margin) if miss.excess > -margin else ""
