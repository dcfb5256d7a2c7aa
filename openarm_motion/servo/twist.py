# SPDX-License-Identifier: Apache-2.0
"""Joint velocities for a twist of the tool, and how near the arm is to a singular posture. Base frame, m, rad, s."""

from __future__ import annotations

import numpy as np

from openarm_common.types import Array
from openarm_motion.kinematics.chain import ArmKinematics

#: Singular values below this are damped, m/rad and rad/rad.
_DAMPED = 0.02


def joint_velocities(kinematics: ArmKinematics, q: Array, twist: Array) -> tuple[Array, float]:
    """Least joint velocities (n,) that move the tool by a twist (6,), and the condition number of the Jacobian.

    Near a singular posture they are damped, so that they stay bounded; infinite is the condition of an arm with fewer
    than six joints that can move the tool.
    """
    left, sizes, right = np.linalg.svd(kinematics.jacobian(q), full_matrices=False)
    damping = np.where(sizes < _DAMPED, _DAMPED**2 - sizes**2, 0.0)
    inverse = sizes / (sizes**2 + damping)
    condition = float(sizes[0] / sizes[-1]) if len(sizes) == 6 and sizes[-1] > 1e-9 else np.inf
    return right.T @ (inverse * (left.T @ twist)), condition


def condition(kinematics: ArmKinematics, q: Array) -> float:
    """Condition number of the Jacobian at a configuration (n,)."""
    return joint_velocities(kinematics, q, np.zeros(6))[1]
