# SPDX-License-Identifier: Apache-2.0
"""Objects of any shape: read from a folder, or drawn as `superquadric:SEED`. Lengths in m, in the object's own frame.

A folder holds `object.yaml` (`ObjectFile`), `visual.obj` and, as convex parts by `o` or `g`, `collision.obj`; without
this the visual mesh is decomposed. What folders hold comes from others: sizes are bounded, and no file outside is read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, FiniteFloat, field_validator, model_validator

from openarm_common.config import Config, load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.decompose import decomposed
from openarm_common.objects.obj_file import ObjMesh, read_obj
from openarm_common.objects.resting import Side, resting_sides
from openarm_common.objects.solid import Part, hull_part, mass_centre, moments
from openarm_common.objects.superquadric import draw_superquadric
from openarm_common.printable import brief
from openarm_common.resources import is_file, models_dir
from openarm_common.types import Array, Ints

SUPERQUADRIC = "superquadric:"
#: kg/m3, of an object without a mass.
DENSITY = 700.0
#: Most convex parts; least and largest edge of the box around an object, m; least and largest mass, kg.
MAX_PARTS, MIN_EDGE, MAX_EDGE, MIN_MASS, MAX_MASS = 128, 0.002, 0.5, 0.001, 10.0
#: A part is taken for convex when its mesh has this share of the volume of its hull.
_CONVEX = 0.8
#: Share of edges without a second triangle from which on a mesh is open.
_OPEN = 0.02
_WELD = 1e-6
_COLORS_OF_WORDS = {
    "red": (0.80, 0.08, 0.08), "orange": (0.95, 0.45, 0.04), "yellow": (0.93, 0.82, 0.05), "green": (0.08, 0.58, 0.18),
    "blue": (0.06, 0.25, 0.80), "purple": (0.46, 0.10, 0.66), "grey": (0.45, 0.45, 0.45), "white": (0.92, 0.92, 0.90),
    "black": (0.07, 0.07, 0.08), "brown": (0.42, 0.26, 0.13), "silver": (0.68, 0.69, 0.71),
}  # fmt: skip

Share = Annotated[FiniteFloat, Field(ge=0.0, le=1.0)]
Coefficient = Annotated[FiniteFloat, Field(ge=0.0, le=10.0)]
Rgb = tuple[float, float, float]


class ObjectFile(Config):
    """What `object.yaml` says of an object."""

    label: str = Field(
        default="", max_length=60, description="what it is; the name of the folder where it is not given"
    )
    mass: FiniteFloat | None = Field(
        default=None, ge=MIN_MASS, le=MAX_MASS, description="kg; the volume times the density of hard wood without"
    )
    friction: Coefficient | tuple[Coefficient, Coefficient, Coefficient] | None = Field(
        default=None, description="against table and objects: sliding, or with torsional and rolling (m)"
    )
    color: str | tuple[Share, Share, Share] | tuple[Share, Share, Share, Share] = Field(
        default="grey", description="red, green, blue from 0 to 1, or a name; colour means the same"
    )
    texture: str = Field(default="", max_length=100, description="picture of visual.obj, PNG or JPEG in the folder")
    licence: str = Field(default="", max_length=400, description="of the meshes; license means the same")
    source: str = Field(default="", max_length=400, description="where the meshes are from")

    @model_validator(mode="before")
    @classmethod
    def _spelling(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        other = {"colour": "color", "license": "licence"}
        return {other.get(key, key): value for key, value in data.items()}  # pyright: ignore

    @field_validator("color")
    @classmethod
    def _known(cls, value: Any) -> Any:
        if isinstance(value, str) and value not in _COLORS_OF_WORDS:
            raise ValueError(f"unknown colour; expected [red, green, blue] or one of {', '.join(_COLORS_OF_WORDS)}")
        return value

    @property
    def rgb(self) -> Rgb:
        """Red, green, blue, 0 to 1."""
        return _COLORS_OF_WORDS[self.color] if isinstance(self.color, str) else self.color[:3]


@dataclass(frozen=True, eq=False)
class ObjectModel:
    """An object.

    Attributes:
        source: Name in scenes.
        label: Label of the object.
        mass: kg.
        friction: Sliding, torsional and rolling (m) against table and objects; None: those of the simulation.
        rgb: Colour, 0 to 1; of what has a texture, None.
        visual: Visual shape.
        texture: Its picture; None without.
        parts: Convex parts of even density, which are in contact.
    """

    source: str
    label: str
    mass: float
    friction: tuple[float, ...] | None
    rgb: Rgb
    visual: ObjMesh
    texture: Path | None
    parts: tuple[Part, ...]

    @cached_property
    def sides(self) -> tuple[Side, ...]:
        """Sides that it rests on, the most frequent first."""
        return resting_sides(self.parts)

    @cached_property
    def centre_of_mass(self) -> Array:
        """(3,) m."""
        return mass_centre(self.parts)

    @cached_property
    def points(self) -> Array:
        """Corners of the parts (n, 3), m."""
        return np.concatenate([part.vertices for part in self.parts])


def object_names(folder: Path | None = None) -> tuple[str, ...]:
    """Return the names of the object folders in a folder, of `models/objects` without one; sorted."""
    return tuple(sorted(path.parent.name for path in (folder or _own()).glob("*/object.yaml")))


def load_object(source: str) -> ObjectModel:
    """Read or draw an object; the same unchanged files are read once.

    Args:
        source: Name of a folder in `models/objects`, path of a folder, or `superquadric:SEED`.

    Raises:
        OpenArmError: CONFIG_INVALID, naming what is wrong and what was expected; ENVIRONMENT, without `coacd` where it
            is needed.
    """
    if source.startswith(SUPERQUADRIC):
        text = source.removeprefix(SUPERQUADRIC)
        if not (text.isdecimal() and text.isascii() and len(text) <= 18):
            raise OpenArmError(Code.CONFIG_INVALID, f"object {brief(source)}: expected {SUPERQUADRIC}SEED, a number")
        return _superquadric(int(text))
    folder = Path(source) if "/" in source or source.startswith(".") else _own() / source
    if not is_file(folder / "object.yaml"):
        names = ", ".join(object_names()) or "none"
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"no object {brief(source)}: there is no object.yaml in {str(folder)[:300]!r}; objects: {names},"
            f" {SUPERQUADRIC}SEED, or the path of a folder (with a /)",
        )
    return _read(source, folder, tuple(_stamp(folder / name) for name in _FILES))


_FILES = ("object.yaml", "visual.obj", "collision.obj")


def _own() -> Path:
    return models_dir() / "objects"


def _stamp(path: Path) -> tuple[int, int]:
    return (path.stat().st_mtime_ns, path.stat().st_size) if is_file(path) else (0, 0)


@lru_cache(maxsize=64)
def _superquadric(seed: int) -> ObjectModel:
    shape, rgb = draw_superquadric(seed)
    part = hull_part(shape.points())
    assert part is not None
    none = np.empty((0, 2))
    flat = np.full_like(part.triangles, -1)
    mesh = ObjMesh(part.vertices, none, part.triangles, flat, np.zeros(len(part.triangles), np.int64), ("",), "")
    mass = round(min(max(part.volume * DENSITY, 0.03), 0.4), 3)
    source = f"{SUPERQUADRIC}{seed}"
    return ObjectModel(source, f"superquadric {seed}", mass, None, rgb, mesh, None, (part,))


@lru_cache(maxsize=128)
def _read(source: str, folder: Path, _stamps: tuple[tuple[int, int], ...]) -> ObjectModel:
    described, collision = folder / "object.yaml", folder / "collision.obj"
    said = load_config(described, ObjectFile)
    visual = read_obj(folder / "visual.obj")
    _check_size(visual.vertices[np.unique(visual.triangles)], folder / "visual.obj")
    if is_file(collision):
        parts = _parts(read_obj(collision), collision)
    else:
        vertices, triangles = _closed(visual, folder / "visual.obj")
        hulls = (hull_part(points) for points in decomposed(vertices, triangles, str(folder)))
        parts = tuple(part for part in hulls if part is not None)
    if not 0 < len(parts) <= MAX_PARTS:
        text = f"has {len(parts)} convex parts, expected 1 to {MAX_PARTS}; put parts together"
        raise OpenArmError(Code.CONFIG_INVALID, f"{collision} {text}")
    _check_size(np.concatenate([part.vertices for part in parts]), collision)
    volume = sum(part.volume for part in parts)
    friction = said.friction
    if isinstance(friction, float | int):
        friction = (float(friction), 0.005, 0.0001)
    return ObjectModel(
        source,
        said.label or folder.name.replace("_", " "),
        said.mass or min(max(volume * DENSITY, MIN_MASS), MAX_MASS),
        friction,
        said.rgb,
        visual,
        _texture(folder, said.texture, visual),
        parts,
    )


def _check_size(points: Array, path: Path) -> None:
    edges = np.ptp(points, axis=0)
    if edges.max() > MAX_EDGE or edges.max() < 5.0 * MIN_EDGE or edges.min() < MIN_EDGE / 2.0:
        told = " x ".join(f"{edge:.4g}" for edge in edges)
        hint = "is it in millimetres?" if edges.max() > MAX_EDGE else "expected metres"
        limits = f"edges of {MIN_EDGE:g} to {MAX_EDGE:g} m"
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} is {told} m large, expected {limits}; {hint}")


def _parts(mesh: ObjMesh, path: Path) -> tuple[Part, ...]:
    """Return the hulls of the groups of a collision mesh; flat ones are left out."""
    numbers = np.unique(mesh.groups)
    if len(numbers) > 4 * MAX_PARTS:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has {len(numbers)} groups, expected at most {MAX_PARTS}")
    parts: list[Part] = []
    for number in numbers:
        triangles = mesh.triangles[mesh.groups == number]
        part = hull_part(np.unique(mesh.vertices[np.unique(triangles)], axis=0))
        if part is None:
            continue
        volume = abs(moments(mesh.vertices, triangles)[0])
        if volume < _CONVEX * part.volume and _open_share(mesh.vertices, triangles) == 0.0:
            name = mesh.names[number] or "without a name"
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"{path}: part {brief(name)} is not convex: it fills {100.0 * volume / part.volume:.0f} % of its hull;"
                " split it into convex groups, or leave collision.obj out and have visual.obj decomposed",
            )
        parts.append(part)
    if not parts:
        raise OpenArmError(Code.CONFIG_INVALID, f"{path} has no part with a volume; expected closed convex groups")
    return tuple(parts)


def _closed(mesh: ObjMesh, path: Path) -> tuple[Array, Ints]:
    """Return vertices and triangles of a closed mesh with points welded that are at one place.

    Raises:
        OpenArmError: CONFIG_INVALID, when it is open or has no volume.
    """
    _, first, index = np.unique(np.round(mesh.vertices / _WELD), axis=0, return_index=True, return_inverse=True)
    vertices, triangles = mesh.vertices[first], index.reshape(-1)[mesh.triangles]
    triangles = triangles[(np.sort(triangles, axis=1)[:, 1:] != np.sort(triangles, axis=1)[:, :-1]).all(axis=1)]
    share = _open_share(vertices, triangles) if len(triangles) else 1.0
    volume = abs(moments(vertices, triangles)[0]) if len(triangles) else 0.0
    if share > _OPEN or volume < 1e-9:
        what = f"is open: {100.0 * share:.0f} % of its edges have one triangle" if share > _OPEN else "has no volume"
        raise OpenArmError(
            Code.CONFIG_INVALID,
            f"{path} {what}, so its mass and convex parts are not known; close the mesh, or add collision.obj with a"
            " convex part a group",
        )
    return vertices, triangles


def _open_share(vertices: Array, triangles: Ints) -> float:
    """Return the share of edges that only one triangle has, after points at one place are one."""
    _, index = np.unique(np.round(vertices / _WELD), axis=0, return_inverse=True)
    same = index.reshape(-1)[triangles]
    edges = np.sort(np.concatenate([same[:, [0, 1]], same[:, [1, 2]], same[:, [2, 0]]]), axis=1)
    counts = np.unique(edges[edges[:, 0] != edges[:, 1]], axis=0, return_counts=True)[1]
    return float(np.mean(counts == 1)) if len(counts) else 1.0


def _texture(folder: Path, said: str, mesh: ObjMesh) -> Path | None:
    """Return the picture of an object: that of object.yaml, else the first of the materials of the visual mesh.

    Raises:
        OpenArmError: CONFIG_INVALID, for one that is not in the folder.
    """
    if not len(mesh.uv):
        if said:
            text = f"names the texture {brief(said)}, but visual.obj has no texture coordinates (`vt` lines)"
            raise OpenArmError(Code.CONFIG_INVALID, f"{folder}/object.yaml {text}")
        return None
    name = said or _picture_of(folder, mesh.materials)
    if not name:
        return None
    path = folder / name
    inside = path.resolve().is_relative_to(folder.resolve())
    if not inside or not is_file(path):
        where = "object.yaml" if said else mesh.materials
        text = f"names the texture {brief(name)}, which is {'missing' if inside else 'outside the folder'}"
        raise OpenArmError(Code.CONFIG_INVALID, f"{folder}/{where} {text}; put the picture into the folder")
    return path


def _picture_of(folder: Path, materials: str) -> str:
    """Return the first `map_Kd` of a file of materials in the folder; "" without."""
    path = folder / materials
    if not materials or not path.resolve().is_relative_to(folder.resolve()) or not is_file(path):
        return ""
    from openarm_common.config import read_text

    for line in read_text(path).splitlines():
        word, _, rest = line.strip().partition(" ")
        if word == "map_Kd":
            return rest.split()[-1] if rest.split() else ""
    return ""
