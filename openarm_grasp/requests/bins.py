# SPDX-License-Identifier: Apache-2.0
"""Bins: rectangles on the table, and which class belongs into which. Base frame, m."""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from pydantic import Field, model_validator

from openarm_common.config import Config, Interval, load_config
from openarm_grasp.perception.detections import Spot


class Bin(Config):
    """A rectangle on the table."""

    x: Interval = Field(description="near and far edge, m")
    y: Interval = Field(description="right and left edge, m")

    def slots(self, spacing: float) -> tuple[Spot, ...]:
        """Places for objects, row by row, `spacing` apart; a small bin has one, in its middle."""
        return tuple((x, y) for x in _steps(*self.x, spacing) for y in _steps(*self.y, spacing))


def _steps(low: float, high: float, spacing: float) -> list[float]:
    n = max(1, int((high - low) / spacing + 1e-9))
    middle = (low + high) / 2.0
    return [round(float(v), 4) for v in middle + (np.arange(n) - (n - 1) / 2.0) * spacing]


class Bins(Config):
    """Bins, and which class belongs into which."""

    bins: dict[str, Bin] = Field(min_length=1, description="by name")
    classes: dict[str, str] = Field(default_factory=dict, description="name of the bin by label; others go to `rest`")
    rest: str = Field(default="", description="bin of labels that `classes` lacks; empty: they are left alone")
    spacing: float = Field(default=0.12, gt=0.02, le=0.5, description="between the middles of two objects, m")

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name in (*self.classes.values(), self.rest):
            if name and name not in self.bins:
                raise ValueError(f"there is no bin {name!r}; bins: {', '.join(self.bins)}")
        return self

    def of(self, label: str) -> str:
        """Name of the bin of a label; "" when it belongs into none."""
        return self.classes.get(label, self.rest)


def load_bins(path: Path) -> Bins:
    """Read bins from a YAML file.

    Raises:
        OpenArmError: CONFIG_INVALID, naming file and key.
    """
    return load_config(path, Bins)
