# SPDX-License-Identifier: Apache-2.0
"""What a draft of a robot takes from its maker's MJCF in another way, or has in addition: a YAML file. m, rad."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from typing import Self, TypeVar

from pydantic import Field, model_validator

from openarm_common.config import Config

Vector = tuple[float, float, float]
ValueT = TypeVar("ValueT")


class BoxEdit(Config):
    """A box on a link.

    Attributes:
        name: Of the element.
        size: Full edges.
        xyz: Of its middle, in the frame of the link.
        material: Of a visual.
    """

    name: str
    size: Vector
    xyz: Vector = (0.0, 0.0, 0.0)
    material: str = ""


class FrameEdit(Config):
    """A link without shapes.

    Attributes:
        parent: Link that it is fixed to.
        xyz: Of its origin.
        rpy: Of its axes.
        site: Site of the MJCF that it is at, in place of the above.
        camera: Camera of the MJCF that it is at, z forward, y down.
    """

    parent: str = ""
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)
    site: str = ""
    camera: str = ""

    @model_validator(mode="after")
    def _one_place(self) -> Self:
        if sum(map(bool, (self.parent, self.site, self.camera))) != 1:
            raise ValueError("expected one of parent, site, camera")
        return self


class Edits(Config):
    """What the file says. Keys of `velocity`, `damping`, `detail` are patterns: `*` is any text.

    Attributes:
        base: Link that has what the MJCF fixes to the world.
        velocity: Limits by joint, rad/s or m/s; an MJCF has none.
        damping: By joint in place of the MJCF's, N m s/rad or N s/m.
        boxes: All shapes of a link, seen and touched.
        replace: A collision shape by its name.
        frames: Links in addition.
        materials: rgba of those of boxes.
        triangles: Of all visual meshes together, at most.
        detail: Weight by visual mesh file: the greater, the more of its triangles stay.
    """

    base: str = "base_link"
    velocity: Mapping[str, float] = Field(default_factory=dict)
    damping: Mapping[str, float] = Field(default_factory=dict)
    boxes: Mapping[str, tuple[BoxEdit, ...]] = Field(default_factory=dict)
    replace: Mapping[str, BoxEdit] = Field(default_factory=dict)
    frames: Mapping[str, FrameEdit] = Field(default_factory=dict)
    materials: Mapping[str, tuple[float, float, float, float]] = Field(default_factory=dict)
    triangles: int = Field(default=60_000, ge=1000)
    detail: Mapping[str, float] = Field(default_factory=dict)


def matching(patterns: Mapping[str, ValueT], name: str, default: ValueT) -> ValueT:
    """Return the value of the first pattern that a name matches."""
    return next((value for pattern, value in patterns.items() if fnmatchcase(name, pattern)), default)
