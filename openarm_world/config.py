# SPDX-License-Identifier: Apache-2.0
"""What counts as seen, as the same object, and as gone."""

from __future__ import annotations

from pydantic import Field

from openarm_common.config import Config


class WorldConfig(Config):
    """Thresholds of the objects; each says why it is what it is."""

    noise: float = Field(
        default=0.006,
        gt=0.0,
        le=0.1,
        description="a point is seen where the depth z differs by no more than this times z², 1/m: 1.5 standard"
        " deviations of a pixel of a D435",
    )
    least_noise: float = Field(
        default=0.003, gt=0.0, le=0.05, description="nor by less than this, m: depth comes in whole millimetres"
    )
    spacing: float = Field(
        default=0.005,
        gt=0.0,
        le=0.05,
        description="distance of the points that are kept of an object, m: 300 of a thing of a hand's size",
    )
    in_view: float = Field(
        default=0.1,
        ge=0.0,
        le=1.0,
        description="share of its points in view from which on an object is judged: fewer are a rim, which is noise",
    )
    same: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        description="share of the points in view of an object from which on a detection, or what a hand holds, has it:"
        " the majority",
    )
    gone: float = Field(
        default=0.5,
        gt=0.0,
        le=1.0,
        description="share of the points in view that are seen through from which on an object has left its place: what"
        " stands stays below 0.01",
    )
    gate: float = Field(
        default=0.10, ge=0.0, le=1.0, description="farthest that an object is followed that moves unseen, m: one push"
    )
    forget: float = Field(
        default=600.0, gt=0.0, description="an object that was not seen for so long is forgotten, s: bounds the memory"
    )
