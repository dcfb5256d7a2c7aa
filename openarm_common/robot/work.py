# SPDX-License-Identifier: Apache-2.0
"""Where a robot works: the table in front of it, and the regions that its arms reach. Base frame, metres."""

from __future__ import annotations

from typing import Self

from pydantic import Field, model_validator

from openarm_common.config import Config, Interval


class Table(Config):
    """A table with four legs; its top is a box."""

    top_z: float = Field(ge=0.05, le=1.2, description="height of the top, m")
    x: Interval = Field(description="front and back edge, m")
    y: Interval = Field(description="right and left edge, m")
    thickness: float = Field(gt=0.0, le=0.2, description="of the top, m")

    def at(self, height: float) -> Table:
        """Return the same table with its top at another height, base frame, m."""
        return self.model_copy(update={"top_z": height})

    @property
    def centre(self) -> tuple[float, float]:
        """Middle of the top, m."""
        return (self.x[0] + self.x[1]) / 2.0, (self.y[0] + self.y[1]) / 2.0

    @property
    def extents(self) -> tuple[float, float, float]:
        """Edges of the top, m."""
        return self.x[1] - self.x[0], self.y[1] - self.y[0], self.thickness


class Region(Config):
    """Where an arm can grasp a cube of any yaw from above with a tilt up to 30°."""

    x: Interval = Field(description="m")
    abs_y: Interval = Field(description="|y| to the arm's own side, m")

    @model_validator(mode="after")
    def _to_a_side(self) -> Self:
        if self.abs_y[0] < 0.0:
            raise ValueError(f"abs_y is {list(self.abs_y)}, expected distances from the middle")
        return self


class Strip(Config):
    """A strip along x in the middle of the table, which both arms reach: objects change hands there."""

    x: Interval = Field(description="its ends, m")
    abs_y: float = Field(gt=0.0, le=0.2, description="half of its width, m")


class Work(Config):
    """Where a robot works.

    Attributes:
        table: Table of scenes that say nothing else.
        least_x: Front edge of any table, at least: one that reaches further back would stand in the robot.
        region: Region of objects.
        hand_over: None with one arm.
    """

    table: Table
    least_x: float
    region: Region
    hand_over: Strip | None = None

    @model_validator(mode="after")
    def _clear(self) -> Self:
        if fault := self.fault_of(self.table):
            raise ValueError(fault)
        return self

    @property
    def strip(self) -> Strip:
        """Where objects change hands; with one arm, where they would."""
        return self.hand_over or Strip(x=self.region.x, abs_y=max(self.region.abs_y[0], 0.01))

    def fault_of(self, table: Table) -> str:
        """Return why a table cannot stand before this robot; empty when it can."""
        if table.x[0] >= self.least_x:
            return ""
        front = f"x is {table.x[0]:g}, expected at least {self.least_x:g}"
        return f"the front edge of the table would stand in the robot: {front}"
