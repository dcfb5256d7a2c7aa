# SPDX-License-Identifier: Apache-2.0
"""Watches what grasps say about a camera: a mount that has moved shows as the same bias in grasp after grasp.

A closing hand centres the object between its fingers, wherever the camera thought it was. So along the opening axis
the hand knows where it puts the object down, and what the camera sees there next to it is the camera's own error in
that direction. Across that axis the object keeps the error it was grasped with, and nothing is learned. Each placed
object measures one direction; turned hands measure the others. Base frame, m.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from openarm_common.types import Array
from openarm_grasp.config import DriftConfig


@dataclass(frozen=True)
class Drift:
    """What the residuals of a camera come to.

    Attributes:
        camera: Which.
        bias: (2,) mean residual, base frame, m: where the camera sees objects, less where they are.
        grasps: How many.
        alarm: The bias is large and sure.
    """

    camera: str
    bias: Array
    grasps: int
    alarm: bool

    @property
    def message(self) -> str:
        """One sentence."""
        size = float(np.linalg.norm(self.bias)) * 1e3
        text = (
            f"camera {self.camera!r} is off by {size:.1f} mm (x {self.bias[0] * 1e3:+.1f}, y {self.bias[1] * 1e3:+.1f})"
        )
        text += f" over {self.grasps} grasps"
        return f"{text}: its mount has moved, or its calibration is wrong; calibrate it again" if self.alarm else text


class DriftWatch:
    """Collects residuals of a camera.

    Args:
        config: When to raise an alarm.
        camera: That sees the objects.
    """

    def __init__(self, config: DriftConfig, camera: str) -> None:
        self._config, self._camera = config, camera
        self._seen = deque[tuple[Array, float]](maxlen=config.window)

    def add(self, direction: Array, residual: float) -> None:
        """Take one measurement.

        Args:
            direction: (2,) unit vector in which the error was measured, base frame.
            residual: Seen less true along it, m.
        """
        self._seen.append((direction, residual))

    def drift(self) -> Drift:
        """What is known of the camera.

        The bias is the least-squares solution of all measurements, each of one direction; a little damping
        keeps a direction that no grasp has measured at zero.
        """
        n = len(self._seen)
        if n < self._config.least:
            return Drift(self._camera, np.zeros(2), n, alarm=False)
        A = np.array([direction for direction, _ in self._seen])
        b = np.array([residual for _, residual in self._seen])
        information = A.T @ A + 0.1 * np.eye(2)
        bias = np.asarray(np.linalg.solve(information, A.T @ b), dtype=np.float64)
        sigma = max(float(np.std(b - A @ bias)), 0.0005)
        error = sigma * np.sqrt(np.diag(np.linalg.inv(information)))
        size = float(np.linalg.norm(bias))
        along = bias / size if size > 0.0 else np.array([1.0, 0.0])
        sure = size > self._config.sigmas * float(np.linalg.norm(along * error))
        return Drift(self._camera, bias, n, alarm=size > self._config.bias and sure)
