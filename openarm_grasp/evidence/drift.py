# SPDX-License-Identifier: Apache-2.0
"""Watches what grasps say about a camera: a mount that has moved shows as the same bias in grasp after grasp.

A closing hand centres the object between its fingers, wherever the camera thought it was. So along the opening axis
the hand knows where it puts the object down, and what the camera sees there next to it is the camera's own error in
that direction. Across that axis the object keeps the error it was grasped with, and nothing is learned. Each placed
object measures one direction; turned hands measure the others. A camera that was shifted is off by the same for every
arm; where residuals differ by arm, it was turned, or the joint zeros of an arm are wrong. Base frame, m.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np

from openarm_common.types import Array
from openarm_grasp.config import DriftConfig

#: A direction that no grasp has measured stays at zero; where arms are compared, it stays unknown to 2 cm.
_DAMPING, _UNKNOWN = 0.1, 0.0006
#: Spread of residuals that no few grasps show to be smaller, m; and grasps before an arm is compared.
_LEAST_SIGMA, _LEAST_OF_ARM = 0.0005, 3


@dataclass(frozen=True)
class Drift:
    """What the residuals of a camera come to.

    Attributes:
        camera: Name of the camera.
        bias: (2,) mean residual, base frame, m: where the camera sees objects, less where they are.
        grasps: Number of grasps.
        alarm: The bias is large and sure.
        arms: Bias of each arm, m, where they surely differ.
    """

    camera: str
    bias: Array
    grasps: int
    alarm: bool
    arms: Mapping[str, Array] = field(default_factory=dict[str, Array])

    @property
    def message(self) -> str:
        """One sentence."""
        if self.arms:
            each = ", ".join(f"{arm} by {_millimetres(bias)}" for arm, bias in self.arms.items())
            return (
                f"camera {self.camera!r} is off differently for each arm ({each}) over {self.grasps} grasps: it has"
                " turned, or the joint zeros of an arm are wrong; calibrate it again: the verdict names wrong zeros"
            )
        text = f"camera {self.camera!r} is off by {_millimetres(self.bias)} over {self.grasps} grasps"
        cause = "its mount has moved, or its calibration or the joint zeros of the arm are wrong; calibrate it again"
        return f"{text}: {cause}" if self.alarm else text


def _millimetres(bias: Array) -> str:
    x, y = bias * 1e3
    return f"{math.hypot(x, y):.1f} mm (x {x:+.1f}, y {y:+.1f})"


class DriftWatch:
    """Collects residuals of a camera.

    Args:
        config: When to raise an alarm.
        camera: Camera that sees the objects.
    """

    def __init__(self, config: DriftConfig, camera: str) -> None:
        self._config, self._camera = config, camera
        self._seen = deque[tuple[str, Array, float]](maxlen=config.window)

    def add(self, arm: str, direction: Array, residual: float) -> None:
        """Take one measurement.

        Args:
            arm: Arm whose hand placed the object.
            direction: (2,) unit vector in which the error was measured, base frame.
            residual: Seen less true along it, m.
        """
        self._seen.append((arm, direction, residual))

    def drift(self) -> Drift:
        """What is known of the camera, and of the arms."""
        n = len(self._seen)
        if n < self._config.least:
            return Drift(self._camera, np.zeros(2), n, alarm=False)
        bias, covariance = _fitted(self._seen, _DAMPING)
        fits: dict[str, tuple[Array, Array]] = {}
        for arm in sorted({arm for arm, *_ in self._seen}):
            mine = [one for one in self._seen if one[0] == arm]
            if len(mine) >= _LEAST_OF_ARM:
                fits[arm] = _fitted(mine, _UNKNOWN)
        pairs = combinations(fits.values(), 2)
        differ = any(self._sure(one - other, spread + wider) for (one, spread), (other, wider) in pairs)
        arms = {arm: fit[0] for arm, fit in fits.items()} if differ else {}
        return Drift(self._camera, bias, n, alarm=differ or self._sure(bias, covariance), arms=arms)

    def _sure(self, bias: Array, covariance: Array) -> bool:
        """Whether a bias is large, and larger than its own error along it."""
        size = float(np.linalg.norm(bias))
        along = bias / size if size > 0.0 else np.array([1.0, 0.0])
        error = float(np.linalg.norm(along * np.sqrt(np.diag(covariance))))
        return size > self._config.bias and size > self._config.sigmas * error


def _fitted(measurements: Collection[tuple[str, Array, float]], damping: float) -> tuple[Array, Array]:
    """Bias (2,) and covariance (2, 2): least squares, each measurement of one direction.

    Args:
        measurements: Arm, direction, residual.
        damping: Information that the bias is zero, in measurements.
    """
    A = np.array([direction for _, direction, _ in measurements])
    b = np.array([residual for *_, residual in measurements])
    information = A.T @ A + damping * np.eye(2)
    bias = np.asarray(np.linalg.solve(information, A.T @ b), dtype=np.float64)
    sigma = max(float(np.linalg.norm(b - A @ bias)) / math.sqrt(max(len(b) - 2, 1)), _LEAST_SIGMA)
    return bias, np.asarray(sigma**2 * np.linalg.inv(information), dtype=np.float64)
