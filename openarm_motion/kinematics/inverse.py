# SPDX-License-Identifier: Apache-2.0
"""All configurations at a tool pose, and one followed along a path: closed form where the arm allows it, else numeric.

The rest of the package asks only here, so an arm of any build behaves the same, if more slowly. Poses are `T_base_tool`
(4, 4) in the description's root frame; angles rad, lengths m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from openarm_common.errors import OpenArmError
from openarm_common.robot.turns import nearest_turns
from openarm_common.types import Array
from openarm_motion.kinematics.chain import ArmKinematics, IkResult, IkSolution
from openarm_motion.kinematics.srs import SrsArm, SrsMiss

#: Numeric solutions nearer to each other than this in every joint count as one.
_SAME = 0.05
#: Guesses for several solutions of a numeric arm; random ones of a pose that the closed form finds nothing for.
_GUESSES = 24
_RESTARTS = 60
#: The same where the closed form proves that it is out of reach by more than rounding, m.
_OUT_OF_REACH, _ROUNDED = 4, 1e-3


@dataclass(frozen=True, eq=False)
class _Search:
    """What was found at a pose; where nothing was, the nearest that is within the limits, and what is in the way."""

    found: list[IkSolution]
    nearest: IkResult | None = None
    miss: SrsMiss | None = None


class InverseKinematics:
    """Inverse kinematics of one arm.

    Args:
        kinematics: The arm.
        swivels: Number of swivel angles of a whole turn that are tried.
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

    def solutions(self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None) -> list[IkSolution]:
        """Configurations at a pose within the limits less `margin`.

        Args:
            pose: (4, 4).
            margin: Kept from the limits, rad.
            near: (n,) A first guess where solving is numeric, and one more swivel angle to try where it is not; joints
                that turn without end are in the turn nearest to it.
        """
        return self._search(pose, margin, near).found

    def position_solutions(self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None) -> list[IkSolution]:
        """Configurations whose tool origin is at the position of `pose`, in whatever orientation."""
        return self._search(pose, margin, near, position_only=True).found

    def nearest(
        self, pose: Array, seed: ArrayLike | None = None, *, position_only: bool = False, margin: float = 0.0
    ) -> IkResult:
        """One solution: near to the seed when there is one, and the nearest pose when there is none."""
        arm = self.kinematics
        if self._closed is None or position_only:
            first = arm.ik(pose, seed, position_only=position_only, margin=margin)
            found = [] if first.success else self._several(pose, margin, seed, position_only=position_only)
        else:
            first = arm.ik(pose, seed, margin=margin, restarts=0)
            search = _Search([]) if first.success else self._closed_form(self._closed, pose, margin, seed)
            first, found = search.nearest or first, search.found
        if first.success or not found:
            return first
        here = arm.middle if seed is None else np.asarray(seed, dtype=np.float64)
        best = min(found, key=lambda solution: float(np.max(np.abs(solution.q - here))))
        return arm.ik(pose, best.q, position_only=position_only, margin=margin, restarts=0)

    def classify(self, q: ArrayLike) -> IkSolution:
        """Swivel angle and branch of a configuration."""
        values = np.asarray(q, dtype=np.float64)
        return IkSolution(values) if self._closed is None else self._closed.classify(values)

    def why_not(
        self, pose: Array, margin: float = 0.0, near: ArrayLike | None = None, *, position_only: bool = False
    ) -> str:
        """Sentences about why a pose has no configuration: the margin, or what binds, and the nearest pose."""
        search = self._search(pose, 0.0, near, position_only=position_only)
        if search.found:
            best = max(search.found, key=lambda solution: self.kinematics.margin(solution.q))
            return f"only nearer to a joint limit than the margin of {margin:g} rad: {self.kinematics.closest(best.q)}"
        reasons: list[str] = []
        if self._closed is not None and search.miss is not None:
            reasons.append(self._binding(search.miss, self._closed))
        if search.nearest is not None:
            p = ", ".join(f"{x:.3f}" for x in self.kinematics.fk(search.nearest.q)[:3, 3])
            reasons.append(
                f"the nearest reachable pose is {search.nearest.away(position_only=position_only)} away, at ({p}) m"
            )
        return "; ".join(reason for reason in reasons if reason)

    def follow(
        self, poses: Array, start: IkSolution, margin: float, max_step: float, swivel_change: float = 0.0
    ) -> tuple[Array, int, str]:
        """Configurations along a path of poses (m, 4, 4), on the branch of `start`.

        Args:
            poses: The first is that of `start`.
            start: Configuration to start from.
            margin: Kept from the joint limits, rad.
            max_step: Greatest change of a joint between neighbouring poses, rad.
            swivel_change: Angle that the elbow swivels by along the path, rad; has no meaning for a numeric arm.

        Returns:
            The path (m, n), the index of the first pose that fails (m when none does), and why it fails.
        """
        if self._closed is not None:
            swivels = start.swivel + swivel_change * np.linspace(0.0, 1.0, poses.shape[0])
            return self._closed.follow(poses, swivels, start, margin, max_step)
        path = np.empty((poses.shape[0], self.kinematics.n))
        q = start.q
        for k, pose in enumerate(poses):
            result = self.kinematics.ik(pose, q, margin=margin, restarts=0)
            path[k] = result.q
            if not result.success:
                return path, k, f"no configuration on this branch: {result.away(position_only=False)} off the line"
            step = np.abs(result.q - q)
            if k > 0 and float(step.max()) > max_step:
                name = self.kinematics.names[int(step.argmax())]
                return path, k, f"{name} would jump by {step.max():.2f} rad between neighbouring points"
            q = result.q
        return path, poses.shape[0], ""

    def _search(self, pose: Array, margin: float, near: ArrayLike | None, *, position_only: bool = False) -> _Search:
        if self._closed is not None and not position_only:
            return self._closed_form(self._closed, pose, margin, near)
        search = self._numeric(pose, margin, near, position_only=position_only)
        return replace(search, found=[self.classify(solution.q) for solution in search.found])

    def _closed_form(self, closed: SrsArm, pose: Array, margin: float, near: ArrayLike | None) -> _Search:
        """Closed form; where it finds nothing, numeric from what comes nearest: within the tolerance there may be more.

        A singular pose, or one rounded at a joint limit, has a configuration that only an inexact solver finds.
        """
        swivels = self._swivels if near is None else np.concatenate([[closed.swivel(near)], self._swivels])
        found = closed.sweep(pose, swivels, margin)
        if found:
            return _Search(self._near(found, near))
        miss = closed.miss(pose, swivels, margin)
        arm = self.kinematics
        results = [arm.ik(pose, guess, margin=margin, restarts=0) for guess in miss.nearest]
        if not any(result.success for result in results):
            restarts = _OUT_OF_REACH if abs(miss.too_far) > _ROUNDED else _RESTARTS
            results.append(arm.ik(pose, near, margin=margin, restarts=restarts))
        best = min(results, key=lambda result: result.cost)
        solved = [closed.classify(result.q) for result in results if result.success]
        return _Search(self._near(solved, near), replace(best, q=self._turned(best.q, near)), miss)

    def _near(self, found: list[IkSolution], near: ArrayLike | None) -> list[IkSolution]:
        """The same configurations, in the turns nearest to another one."""
        if not np.isinf(self.kinematics.upper).any():
            return found
        return [replace(solution, q=self._turned(solution.q, near)) for solution in found]

    def _turned(self, q: Array, near: ArrayLike | None) -> Array:
        return nearest_turns(q, self.kinematics.middle if near is None else near, self.kinematics.upper)

    def _numeric(self, pose: Array, margin: float, near: ArrayLike | None, *, position_only: bool) -> _Search:
        found = self._several(pose, margin, near, position_only=position_only)
        if found:
            return _Search(found)
        result = self.kinematics.ik(pose, near, position_only=position_only, margin=margin)
        return _Search([IkSolution(result.q)] if result.success else [], result)

    def _several(self, pose: Array, margin: float, near: ArrayLike | None, *, position_only: bool) -> list[IkSolution]:
        """What a few guesses lead to, each once."""
        arm = self.kinematics
        if arm.beyond(pose, _ROUNDED):
            return []
        rng = np.random.default_rng(0)
        seeds = [] if near is None else [np.asarray(near, dtype=np.float64)]
        seeds += [arm.middle, *rng.uniform(*arm.span, (_GUESSES, arm.n))]
        found: list[IkSolution] = []
        for seed in seeds:
            result = arm.ik(pose, seed, position_only=position_only, margin=margin, restarts=0)
            q = self._turned(result.q, near)
            if result.success and all(float(np.max(np.abs(q - s.q))) > _SAME for s in found):
                found.append(IkSolution(q))
        return found

    def _binding(self, miss: SrsMiss, closed: SrsArm) -> str:
        if miss.too_far:
            return closed.distance_text(miss.too_far)
        excess = self.kinematics.outside(miss.nearest[0])
        return f"at best {excess}" if excess else ""
