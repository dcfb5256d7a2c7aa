# SPDX-License-Identifier: Apache-2.0
"""What a draft of a robot takes from its maker's MJCF in another way, or has in addition: a YAML file. m, rad."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from typing import Self, TypeVar

from pydantic import Field, model_validator

from openarm_common.config import Config, Interval

Vector = tuple[float, float, float]
ValueT = TypeVar("ValueT")


class BoxEdit(Config):
    """A box on a link.

    Attributes:
        name: Name of the element.
        size: Full edges.
        xyz: Position of its middle, in the frame of the link.
        material: Material of a visual.
    """

    name: str
    size: Vector
    xyz: Vector = (0.0, 0.0, 0.0)
    material: str = ""


class FrameEdit(Config):
    """A link without shapes.

    Attributes:
        parent: Link that it is fixed to.
        xyz: Position of its origin.
        rpy: Orientation of its axes.
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


class AttachEdit(Config):
    """Another MJCF, such as a hand, on a body of the robot.

    Attributes:
        file: Path, from the folder of the robot's MJCF.
        body: Body that carries it.
        prefix: Prefix of its names.
        xyz: Position of its origin, in the frame of the body.
        rpy: Orientation of its axes.
    """

    file: str
    body: str
    prefix: str = ""
    xyz: Vector = (0.0, 0.0, 0.0)
    rpy: Vector = (0.0, 0.0, 0.0)


class MimicEdit(Config):
    """The position of a joint follows another: `multiplier` times it, plus `offset`.

    Attributes:
        joint: Joint that it follows.
        multiplier: rad/rad, or m/m.
        offset: rad, or m.
    """

    joint: str
    multiplier: float = 1.0
    offset: float = 0.0


class Edits(Config):
    """What the file says. In velocity, effort, range, damping, fixed, hulls and detail, `*` of a name is any text.

    Names are those of the robot, with its prefix.

    Attributes:
        base: Link that has what the MJCF fixes to the world.
        prefix: Prefix of all bodies, joints, geoms and sites, for names that no other robot has.
        stand: Position of the MJCF in the base frame, whose origin is on the floor.
        turn: Turn of it there about z, rad.
        attach: Further MJCFs.
        mimic: Joints that follow another, where the MJCF has a linkage or a tendon in place of a coupling.
        fixed: Joints that do not move, of linkages that a tree can't have.
        velocity: Limits by joint, rad/s or m/s; an MJCF has none.
        effort: Limits by joint in place of the MJCF's, N m or N.
        range: The same of positions, such as those that cables leave, rad or m; with them no joint turns without end.
        damping: Damping by joint in place of the MJCF's, N m s/rad or N s/m.
        boxes: All shapes of a link, seen and touched.
        hulls: Links that collide where they are seen: hulls of their visual meshes in place of the MJCF's shapes.
        add: Collision shapes in addition, by link, such as of one that the MJCF only shows.
        replace: A collision shape by its name; none: it is left out.
        frames: Links in addition.
        materials: rgba of those of boxes.
        triangles: Most triangles of all visual meshes together.
        detail: Weight by visual mesh file: the greater, the more of its triangles stay.
        meshes: Robot whose mesh files are taken where name and extents are the same; "": none.
    """

    base: str = "base_link"
    prefix: str = ""
    stand: Vector = (0.0, 0.0, 0.0)
    turn: float = 0.0
    attach: tuple[AttachEdit, ...] = ()
    mimic: Mapping[str, MimicEdit] = Field(default_factory=dict)
    fixed: tuple[str, ...] = ()
    effort: Mapping[str, float] = Field(default_factory=dict)
    range: Mapping[str, Interval] = Field(default_factory=dict)
    velocity: Mapping[str, float] = Field(default_factory=dict)
    damping: Mapping[str, float] = Field(default_factory=dict)
    boxes: Mapping[str, tuple[BoxEdit, ...]] = Field(default_factory=dict)
    hulls: tuple[str, ...] = ()
    add: Mapping[str, tuple[BoxEdit, ...]] = Field(default_factory=dict)
    replace: Mapping[str, BoxEdit | None] = Field(default_factory=dict)
    frames: Mapping[str, FrameEdit] = Field(default_factory=dict)
    materials: Mapping[str, tuple[float, float, float, float]] = Field(default_factory=dict)
    triangles: int = Field(default=60_000, ge=1000)
    detail: Mapping[str, float] = Field(default_factory=dict)
    meshes: str = ""


def matches(patterns: Iterable[str], name: str) -> bool:
    """Return whether a name is of one of the patterns."""
    return any(fnmatchcase(name, pattern) for pattern in patterns)


def matching(patterns: Mapping[str, ValueT], name: str, default: ValueT) -> ValueT:
    """Return the value of the first pattern that a name matches."""
    return next((value for pattern, value in patterns.items() if fnmatchcase(name, pattern)), default)
