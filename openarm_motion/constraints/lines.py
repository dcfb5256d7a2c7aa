# SPDX-License-Identifier: Apache-2.0
"""Collision checks that also keep an arm in a region. m, rad."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from openarm_common.errors import Code
from openarm_common.types import Array
from openarm_motion.collision.line_checks import LineChecks
from openarm_motion.constraints.regions import TaskRegion
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.timing.trajectory import Trajectory
from openarm_motion.timing.validation import dense_times, validate_trajectory

if TYPE_CHECKING:
    from openarm_motion.collision.exact import CollisionScene, Contact
    from openarm_motion.planning.arm import Arm


class ConstrainedLines(LineChecks):
    """A scene whose free configurations also lie in a region.

    Args:
        arm: The arm.
        scene: Planning scene to keep clear of.
        region: Region to stay in.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a joint of another arm.
    """

    exact_only = True

    def __init__(self, arm: Arm, scene: CollisionScene, region: TaskRegion) -> None:
        region.check(arm.names)
        self._arm, self._scene, self._region = arm, scene, region
        self.levers = scene.levers

    @property
    def arms(self) -> Sequence[CollisionScene]:
        """See `LineChecks`."""
        return self._scene.arms

    def contacts(self, q: ArrayLike) -> list[Contact]:
        """See `LineChecks`."""
        return self._scene.contacts(q)

    def collides(self, q: ArrayLike) -> bool:
        """See `LineChecks`; also where the region is left."""
        return bool(self.violations(np.asarray(q)[None])[0]) or self._scene.collides(q)

    def lenient(self, share: float, arms: float | None = None) -> AbstractContextManager[None]:
        """See `LineChecks`."""
        return self._scene.lenient(share, arms)

    def swings(self) -> Array:
        """See `LineChecks`."""
        return self._scene.swings()

    def further(self, by: Array) -> AbstractContextManager[None]:
        """See `LineChecks`."""
        return self._scene.further(by)

    def violations(self, states: Array) -> NDArray[np.bool_]:
        """Which of the configurations (m, n) are outside of the region."""
        return self._region.violations(self._arm.names, states, self._arm.kinematics.fk_many(states))

    def fault(self, q: Array) -> str:
        """What a configuration violates, in words, or ""."""
        return self._region.fault(self._arm.names, q, self._arm.kinematics.fk(q))

    def validate(self, trajectory: Trajectory) -> None:
        """Check a trajectory densely, as `validate_trajectory`.

        Raises:
            PlanFailedError: IN_COLLISION or VIOLATION, with the time.
        """
        validate_trajectory(self._scene, trajectory)
        times = dense_times(trajectory, self.levers)
        states = trajectory.at(times)[0]
        outside = np.flatnonzero(self.violations(states))
        if outside.size:
            k = int(outside[0])
            text = f"after {times[k]:.2f} s of the trajectory {self.fault(states[k])}"
            raise PlanFailedError(Code.VIOLATION, text, "certificate", at=float(times[k]))
