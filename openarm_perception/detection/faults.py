# SPDX-License-Identifier: Apache-2.0
"""Fault injection: objects that the detector misses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from openarm_common.config import Config, RunTimeField

T = TypeVar("T")


class DetectionFaults(Config):
    """Each object is missed in a share of the frames; the same seed and stamps, the same misses."""

    miss_share: float = RunTimeField(default=0.0, ge=0.0, le=1.0, description="share of the detections that are lost")
    seed: int = RunTimeField(default=0, ge=0, description="of which are lost")

    def seen(self, found: Sequence[T], t_ns: int) -> tuple[T, ...]:
        """Return the detections of a frame that are not lost, in order."""
        if self.miss_share == 0.0:
            return tuple(found)
        draws = np.random.default_rng([self.seed, t_ns]).random(len(found))
        return tuple(item for item, draw in zip(found, draws, strict=True) if draw >= self.miss_share)
