# SPDX-License-Identifier: Apache-2.0
"""Circle grids: asymmetric, whose rows are shifted in turn, and symmetric. Lengths in m, in the frame of a board."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator, model_validator

from openarm_common.config import Config
from openarm_common.types import Array

Pixels = NDArray[np.uint8]

#: Samples along each edge of a pixel of a picture.
_SAMPLES = 8


class _Circles(Config, ABC):
    """Black circles on white; what all circle grids have in common."""

    columns: int
    rows: int
    spacing: float
    diameter: float
    border: float

    @property
    @abstractmethod
    def points(self) -> Array:
        """(n, 3) circle centres, row by row."""

    @property
    def feature(self) -> float:
        """Size of what must be large enough in an image, m."""
        return self.diameter

    @property
    def radius(self) -> float:
        """Of a circle, m."""
        return self.diameter / 2.0

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the plate, m."""
        extent = np.ptp(self.points[:, :2], axis=0)
        return float(extent[0]) + 2.0 * self.border, float(extent[1]) + 2.0 * self.border

    def draw(self, pixels_per_metre: float) -> Pixels:
        """Return the grey picture (h, w) of the plate, to scale within half a pixel; black circles on white."""
        width, height = self.size
        return self.picture(round(width * pixels_per_metre), round(height * pixels_per_metre))

    def picture(self, columns: int, rows: int) -> Pixels:
        """Return the grey picture (rows, columns) of exactly the plate; its pixels need not be square."""
        width, height = self.size
        # places of the samples on the plate, m
        u = ((np.arange(columns * _SAMPLES) + 0.5) / (columns * _SAMPLES) - 0.5) * width
        v = ((np.arange(rows * _SAMPLES) + 0.5) / (rows * _SAMPLES) - 0.5) * height
        image = np.full((rows, columns), 255, np.uint8)
        for x, y in self.points[:, :2]:
            left, right, top, bottom = (
                round(edge)
                for edge in (
                    ((x - self.radius) / width + 0.5) * columns - 1, ((x + self.radius) / width + 0.5) * columns + 1,
                    ((y - self.radius) / height + 0.5) * rows - 1, ((y + self.radius) / height + 0.5) * rows + 1,
                )
            )  # fmt: skip
            across = np.square(u[left * _SAMPLES : right * _SAMPLES] - x)
            along = np.square(v[top * _SAMPLES : bottom * _SAMPLES] - y)
            outside = (across[None, :] + along[:, None] > self.radius**2).astype(np.float32) * 255.0
            shares = outside.reshape(bottom - top, _SAMPLES, right - left, _SAMPLES).mean(axis=(1, 3))
            image[top:bottom, left:right] = np.minimum(image[top:bottom, left:right], np.rint(shares))
        return image


class CircleGrid(_Circles):
    """Rows of circles, every second row shifted by one spacing; 4 columns of 11 rows by default."""

    kind: Literal["circles"] = "circles"
    columns: int = Field(default=4, ge=2, le=20, description="circles in a row")
    rows: int = Field(default=11, ge=3, le=41, description="rows; odd, so that half a turn is another pattern")
    spacing: float = Field(
        default=0.02, gt=0.001, le=0.5, description="between rows, half of that between circles of a row, m"
    )
    diameter: float = Field(default=0.015, gt=0.0, le=0.5, description="of a circle, m")
    border: float = Field(default=0.02, ge=0.0, le=0.5, description="of white around the outer circle centres, m")

    @field_validator("rows")
    @classmethod
    def _odd(cls, value: int) -> int:
        if value % 2 == 0:
            raise ValueError("an even number of rows is the same after half a turn; expected an odd number")
        return value

    @model_validator(mode="after")
    def _fits(self) -> CircleGrid:
        # neighbours are sqrt(2) spacings apart
        if self.diameter > 1.2 * self.spacing:
            raise ValueError(f"circles of {self.diameter} m at a spacing of {self.spacing} m touch; at most 1.2 times")
        if self.border < 0.7 * self.diameter:
            raise ValueError(f"border {self.border} m cuts the outer circles; expected at least 0.7 of the diameter")
        return self

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        size = f"{self.spacing * 1e3:g} mm spacing, {self.diameter * 1e3:g} mm circles"
        return f"asymmetric circles {self.columns}x{self.rows}, {size}"

    @property
    def ambiguity(self) -> str:
        """By which rule the board's direction is chosen; none is needed."""
        return ""

    @property
    def points(self) -> Array:
        """(n, 3) circle centres, row by row."""
        grid = [(2 * j + i % 2, i, 0) for i in range(self.rows) for j in range(self.columns)]
        out = np.array(grid, dtype=np.float64) * self.spacing
        return out - (out.max(axis=0) + out.min(axis=0)) / 2.0


class SymmetricCircles(_Circles):
    """Rows and columns of circles; it looks the same after half a turn, and after a quarter where it is square."""

    kind: Literal["symmetric_circles"] = "symmetric_circles"
    columns: int = Field(default=7, ge=3, le=40, description="circles in a row")
    rows: int = Field(default=6, ge=3, le=40, description="rows")
    spacing: float = Field(default=0.03, gt=0.001, le=0.5, description="between neighbours, m")
    diameter: float = Field(default=0.015, gt=0.0, le=0.5, description="of a circle, m")
    border: float = Field(default=0.02, ge=0.0, le=0.5, description="of white around the outer circle centres, m")

    @model_validator(mode="after")
    def _fits(self) -> SymmetricCircles:
        if self.diameter > 0.7 * self.spacing:
            raise ValueError(
                f"circles of {self.diameter} m at a spacing of {self.spacing} m leave too little white; at most 0.7"
            )
        if self.border < 0.7 * self.diameter:
            raise ValueError(f"border {self.border} m cuts the outer circles; expected at least 0.7 of the diameter")
        return self

    @property
    def label(self) -> str:
        """Name for messages and reports."""
        size = f"{self.spacing * 1e3:g} mm spacing, {self.diameter * 1e3:g} mm circles"
        return f"symmetric circles {self.columns}x{self.rows}, {size} ({self.ambiguity})"

    @property
    def ambiguity(self) -> str:
        """By which rule the board's direction is chosen."""
        return upright_rule(self.columns == self.rows)

    @property
    def points(self) -> Array:
        """(n, 3) circle centres, row by row."""
        grid = [(j, i, 0) for i in range(self.rows) for j in range(self.columns)]
        out = np.array(grid, dtype=np.float64) * self.spacing
        return out - (out.max(axis=0) + out.min(axis=0)) / 2.0


def upright_rule(quarter: bool) -> str:
    """Return the rule for boards that look the same after half a turn, or a quarter of one."""
    turn, within = ("a quarter of a turn", 45) if quarter else ("half a turn", 90)
    return f"the same after {turn}: read upright, keep it within {within}° of that in every image"
