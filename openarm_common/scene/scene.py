# SPDX-License-Identifier: Apache-2.0
"""Scenes: a table in front of the robot and the objects on it.

Positions are in the base frame (`world`: x forward, y left, z up), metres; yaw is about z, rad.
A scene is a YAML file in `models/scenes`, or drawn from a seed; what it does not say of its table is as in the
robot's folder. One that does not fit is refused with all its faults.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    Field,
    FiniteFloat,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from openarm_common import se3
from openarm_common.config import Config, load_yaml, validate
from openarm_common.draws import first_fit
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief
from openarm_common.resources import is_file, models_dir
from openarm_common.robot.folder import robot_folder, robot_work
from openarm_common.robot.work import Table
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_common.objects.posed import PosedObject

Rgba = tuple[float, float, float, float]

#: Colours of objects; each lies inside one hue range of `config/params/detector.yaml`.
PALETTE: Mapping[str, Rgba] = MappingProxyType(
    {
        "red": (0.80, 0.08, 0.08, 1.0),
        "orange": (0.95, 0.45, 0.04, 1.0),
        "yellow": (0.93, 0.82, 0.05, 1.0),
        "green": (0.08, 0.58, 0.18, 1.0),
        "blue": (0.06, 0.25, 0.80, 1.0),
        "purple": (0.46, 0.10, 0.66, 1.0),
    }
)
#: Those of scenes: what is grey is found by no colour, so only depth and the map know it.
COLORS: Mapping[str, Rgba] = MappingProxyType({**PALETTE, "grey": (0.45, 0.45, 0.45, 1.0)})
Shape = Literal["box", "cylinder", "sphere", "mesh"]
#: Those that sizes alone describe; a mesh is an object of `openarm_common.objects`.
SHAPES: tuple[Shape, ...] = ("box", "cylinder", "sphere")
RESERVED_NAMES = ("world", "floor", "table", "table_top")
DENSITY = 700.0  # kg/m3, of an object without a mass: hard wood
MAX_EDGE = 0.30  # m, of plain shapes; the limits of meshes are those of `openarm_common.objects.model`
MIN_EDGE = 0.01  # m


def _edge(value: float, info: ValidationInfo) -> float:
    low, high = (0.0, 1.0) if info.data.get("shape") == "mesh" else (MIN_EDGE, MAX_EDGE)
    if not low <= value <= high:
        bound = f"greater than or equal to {low:g}" if value < low else f"less than or equal to {high:g}"
        raise ValueError(f"Input should be {bound}")
    return value


Edge = Annotated[FiniteFloat, AfterValidator(_edge)]
Quaternion = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]
#: Centre to centre in a random scene: the open fingers reach 65 mm to either side, an object up to 50 mm.
SPACING = 0.12
_TOUCH = 1e-4  # m; closer than this is touching, not overlapping


class SceneObject(Config):
    """A free body: a plain shape in one colour, or a mesh.

    `size` is the extents along the object's own axes: a box's edges; a cylinder's diameter, diameter, height; a
    sphere's diameter three times; of a mesh, the upright box around it as it lies, which follows from the object.
    `position` is x, y, or x, y, z of the centre; without z the object is on the table.
    """

    name: str = Field(min_length=1, pattern=r"^[a-z][a-z0-9_]*$", description="unique in the scene")
    label: str = Field(
        default="", description="what the detector calls it; the colour, or of a mesh its object's label"
    )
    shape: Shape
    size: tuple[Edge, Edge, Edge] = Field(description="extents, m; not given for a mesh")
    color: str = Field(description="a colour of the palette, or grey; not given for a mesh")
    mass: float = Field(
        default=0.0, ge=0.0, le=10.0, description="kg; 0 is the volume times the density of hard wood, or its object's"
    )
    position: tuple[FiniteFloat, FiniteFloat] | tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        description="of the centre, m"
    )
    yaw: FiniteFloat = Field(default=0.0, description="rad")
    object: str = Field(
        default="", description="of a mesh: name in models/objects, path of a folder, or superquadric:SEED"
    )
    side: int = Field(default=0, ge=0, description="of a mesh: the side that it rests on, the most frequent is 0")
    attitude: Quaternion | None = Field(
        default=None, description="of a mesh that rests on no side: x, y, z, w of its own frame where yaw is 0"
    )

    @model_validator(mode="before")
    @classmethod
    def _completed(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        if data.get("shape") == "mesh":
            return _mesh_keys(data)  # pyright: ignore[reportUnknownArgumentType]
        return {"label": data.get("color", "")} | data

    @model_serializer(mode="wrap")
    def _own_keys(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out what only a mesh has."""
        told = handler(self)
        return told if self.shape == "mesh" else {key: told[key] for key in told if key not in _OF_MESHES}

    @field_validator("name")
    @classmethod
    def _free_name(cls, value: str) -> str:
        if value in RESERVED_NAMES or value.startswith("openarm_"):
            reserved = ", ".join(RESERVED_NAMES)
            raise ValueError(
                f"reserved for the surroundings and the robot ({reserved}, openarm_…); choose another name"
            )
        return value

    @field_validator("color")
    @classmethod
    def _known_color(cls, value: str, info: ValidationInfo) -> str:
        if value not in COLORS and (value or info.data.get("shape") != "mesh"):
            raise ValueError(f"unknown colour; colours: {', '.join(COLORS)}")
        return value

    @model_validator(mode="after")
    def _of_its_shape(self) -> SceneObject:
        if self.shape == "mesh":
            return self
        if self.object or self.side or self.attitude:
            raise ValueError(f"{', '.join(_OF_MESHES)} are of the shape mesh; this is a {self.shape}")
        if self.shape == "sphere" and len(set(self.size)) > 1:
            raise ValueError(f"a sphere has one diameter; expected three equal extents, got {self.size}")
        return self

    @property
    def posed(self) -> PosedObject:
        """The object of a mesh, as it lies.

        Raises:
            OpenArmError: CONFIG_INVALID, when its files are no longer what they were.
        """
        from openarm_common.objects.posed import posed_object

        return posed_object(self.object, self.side, self.attitude)

    @property
    def corners(self) -> Array | None:
        """Corners (n, 3) of a mesh in its own frame, m; None of a plain shape."""
        return self.posed.corners if self.shape == "mesh" else None

    @property
    def rgba(self) -> Rgba:
        """Colour."""
        return (*self.posed.model.rgb, 1.0) if self.shape == "mesh" else COLORS[self.color]

    @property
    def volume(self) -> float:
        """Cubic metres."""
        if self.shape == "mesh":
            return sum(part.volume for part in self.posed.parts)
        x, y, z = self.size
        return x * y * z * {"box": 1.0, "cylinder": math.pi / 4.0, "sphere": math.pi / 6.0}[self.shape]

    @property
    def mass_kg(self) -> float:
        """Mass, kg: as given, or by volume."""
        return self.mass or self.volume * DENSITY

    def centre(self, table: Table) -> tuple[float, float, float]:
        """Return the position of the centre, m; on the table where the scene gives no z."""
        z = self.position[2] if len(self.position) == 3 else table.top_z + self.size[2] / 2.0
        return self.position[0], self.position[1], z

    def T_world_object(self, table: Table) -> Array:
        """Return the pose, (4, 4)."""
        return se3.make(se3.rot_z(self.yaw), self.centre(table))

    def outline(self) -> Array:
        """Return the convex outline (n, 2) of the footprint in the base frame, m."""
        if self.shape in ("cylinder", "sphere"):
            angles = np.arange(32) * (math.tau / 32.0)
            corners = np.stack([np.cos(angles), np.sin(angles)], axis=1) * (self.size[0] / 2.0)
        else:
            corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (np.array(self.size[:2]) / 2.0)
        return corners @ se3.rot_z(self.yaw)[:2, :2].T + np.array(self.position[:2])


_OF_MESHES = ("object", "side", "attitude")


def _mesh_keys(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a mesh with what its object says: label, mass, size.

    Raises:
        ValueError: The fault of the object, for pydantic.
    """
    from openarm_common.objects.posed import posed_object

    source, side, attitude = data.get("object"), data.get("side", 0), data.get("attitude")
    if not isinstance(source, str) or not source or type(side) is not int:
        raise ValueError("a mesh needs `object`: a name in models/objects, the path of a folder, or superquadric:SEED")
    if attitude is not None:
        numbers = np.array(attitude, np.float64) if _are_numbers(attitude) else np.zeros(0)
        if numbers.shape != (4,) or not np.isfinite(numbers).all() or abs(np.linalg.norm(numbers) - 1.0) > 1e-3:
            raise ValueError(f"attitude is {brief(attitude)}, expected a quaternion x, y, z, w of length 1")
        attitude = tuple(numbers.tolist())
    try:
        posed = posed_object(source, side, attitude)
    except OpenArmError as error:
        raise ValueError(error.message) from error
    told = {"label": posed.model.label, "color": "", **data, "size": posed.size}
    return told | {"mass": data.get("mass") or posed.model.mass}


def _are_numbers(values: Any) -> bool:
    return isinstance(values, list | tuple) and all(isinstance(v, int | float) for v in values)  # pyright: ignore


class Fixture(Config):
    """Something fixed to a link of the robot or to the world, such as a calibration board: seen, but not touched.

    `model` is an MJCF file with one body, whose frame is put at `position` with its z and y axis along the given
    directions of the link.
    """

    name: str = Field(min_length=1, pattern=r"^[a-z][a-z0-9_]*$", description="unique in the scene")
    model: str = Field(min_length=1, description="MJCF file in models/, or an absolute path")
    link: str = Field(default="", description="that carries it; empty is the world")
    position: tuple[float, float, float] = Field(description="of its origin in the frame of the link, m")
    z_axis: tuple[float, float, float] = Field(default=(0.0, 0.0, 1.0), description="direction in the link's frame")
    y_axis: tuple[float, float, float] = Field(default=(0.0, 1.0, 0.0), description="direction in the link's frame")

    @model_validator(mode="after")
    def _two_directions(self) -> Fixture:
        if np.linalg.norm(np.cross(self.z_axis, self.y_axis)) < 1e-6:
            raise ValueError(f"z_axis {self.z_axis} and y_axis {self.y_axis} are parallel or zero")
        return self

    @property
    def T_link_fixture(self) -> Array:
        """Pose in the frame of the link, (4, 4)."""
        return se3.make(se3.rotation_from_z_y(self.z_axis, self.y_axis), self.position)


class Scene(Config):
    """A table, what is on it, and what is fixed somewhere."""

    name: str = Field(default="scene", min_length=1)
    table: Table = Field(default_factory=lambda: robot_work().table)
    objects: tuple[SceneObject, ...] = ()
    fixtures: tuple[Fixture, ...] = ()
    appearance: int | None = Field(
        default=None, ge=0, description="seed of lamps, texture of the table and sheets of paper on it; none: plain"
    )

    @model_serializer(mode="wrap")
    def _own_keys(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """Leave out a plain appearance."""
        told = handler(self)
        return {key: told[key] for key in told if key != "appearance" or self.appearance is not None}

    @field_validator("table", mode="before")
    @classmethod
    def _completed(cls, value: Any) -> Any:
        """What a scene does not say of its table is as in the folder of the robot."""
        return {**robot_work().table.model_dump(), **value} if isinstance(value, Mapping) else value

    @field_validator("table")
    @classmethod
    def _clear_of_the_robot(cls, value: Table) -> Table:
        if fault := robot_work().fault_of(value):
            raise ValueError(fault)
        return value

    def object(self, name: str) -> SceneObject:
        """Return the object of that name.

        Raises:
            OpenArmError: INVALID_ARGUMENT, listing the objects there are.
        """
        for item in self.objects:
            if item.name == name:
                return item
        there = ", ".join(item.name for item in self.objects) or "none"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no object {name!r}; objects: {there}")


def parse_scene(data: Mapping[str, Any], where: str) -> Scene:
    """Validate a scene; `where` begins each fault.

    Raises:
        OpenArmError: SCENE_INVALID, naming each wrong key, and each object that is not on the table, overlaps another,
            or has a name or label that is used twice.
    """
    scene = validate(Scene, dict(data), where, Code.SCENE_INVALID)
    faults = [fault for item in scene.objects for fault in _off_table(item, scene.table)]
    faults += _duplicates("name", (item.name for item in (*scene.objects, *scene.fixtures)))
    faults += _duplicates("label", (item.label for item in scene.objects))
    for a, b in itertools.combinations(scene.objects, 2):
        depth = _overlap(a, b, scene.table)
        if depth > _TOUCH:
            faults.append(f"{_place(a)} and {_place(b)} overlap by {depth * 1e3:.1f} mm; move one of them")
    _refuse(faults, where)
    return scene


def parse_object(data: Mapping[str, Any], table: Table, where: str) -> SceneObject:
    """Validate one object that is to be put on (or above) a table.

    Args:
        data: Keys of `SceneObject`.
        table: The table.
        where: Begins each fault.

    Raises:
        OpenArmError: SCENE_INVALID, naming each wrong key, or that it is not on the table.
    """
    item = validate(SceneObject, dict(data), where, Code.SCENE_INVALID)
    _refuse(_off_table(item, table), where)
    return item


def _refuse(faults: Sequence[str], where: str) -> None:
    if faults:
        raise OpenArmError(Code.SCENE_INVALID, "; ".join(f"{where}: {fault}" for fault in faults))


def load_scene(source: str | Path, seed: int = 0) -> Scene:
    """Read a scene.

    Args:
        source: Name of a file in `models/scenes` or in `scenes` of the robot's folder, which has precedence, a path
            ending in .yaml, "random", or `calibration_CAMERA`: the board for a camera, in the last arm's hand if it is
            fixed (`calibration_CAMERA_NAME_arm`: in another one's).
        seed: Seed of a random scene.

    Raises:
        OpenArmError: SCENE_INVALID, with the faults, or listing the scenes there are.
    """
    if source == "random":
        return random_scene(seed)
    path = Path(source)
    if path.suffix not in (".yaml", ".yml"):
        own, common = (folder / f"{source}.yaml" for folder in _folders())
        path = own if is_file(own) else common
    if not is_file(path):
        from openarm_common.scene.boards import board_scene, board_scenes

        boards = board_scenes()
        if place := boards.get(str(source)):
            return parse_scene({"name": str(source), **board_scene(place)}, str(source))
        names = sorted({*boards, *(file.stem for folder in _folders() for file in folder.glob("*.yaml"))})
        raise OpenArmError(
            Code.SCENE_INVALID,
            f"no scene {brief(str(source))}; scenes: {', '.join([*names, 'random'])}, or the path of a YAML",
        )
    return parse_scene({"name": path.stem} | load_yaml(path, Code.SCENE_INVALID), str(path))


def _folders() -> tuple[Path, Path]:
    return robot_folder() / "scenes", models_dir() / "scenes"


def random_scene(seed: int, count: int | None = None) -> Scene:
    """Draw a scene: one to four objects that either arm can grasp, each in its own colour.

    Cubes, boxes, cylinders and cans; faces and diameters of 40 to 70 mm, heights of 40 to 115 mm, 60 to 350 g.

    Args:
        seed: Same seed, same scene.
        count: Number of objects; None draws it.
    """
    rng, region = np.random.default_rng(seed), robot_work().region
    number = int(rng.integers(1, 5)) if count is None else count
    colors = rng.permutation(list(PALETTE))[:number]
    spots: list[Array] = []

    def draw() -> Array | None:
        side = rng.choice((-1.0, 1.0))
        spot = np.array([rng.uniform(*region.x), side * rng.uniform(*region.abs_y)]).round(4)
        return spot if all(np.hypot(*(spot - other)) >= SPACING for other in spots) else None

    for k in range(number):
        what = f"random scene {seed}: a place for object {k + 1} of {number}, {SPACING:g} m from the others"
        try:
            spots.append(first_fit(what, "take fewer objects, or enlarge work.region of robot.yaml", draw))
        except OpenArmError:
            if count is not None:
                raise
            colors = colors[:k]  # so many as there is room for
            break
    objects: list[SceneObject] = []
    for color, spot in zip(colors, spots, strict=True):
        kind = str(rng.choice(("cube", "box", "cylinder", "can")))
        item = SceneObject(
            name=f"{color}_{kind}",
            shape="box" if kind in ("cube", "box") else "cylinder",
            size=_draw_size(rng, kind),
            color=str(color),
            position=(float(spot[0]), float(spot[1])),
            yaw=round(float(rng.uniform(-math.pi, math.pi)), 4),
        )
        objects.append(item.model_copy(update={"mass": round(min(max(item.mass_kg, 0.06), 0.35), 3)}))
    return parse_scene({"name": f"random_{seed}", "objects": objects}, f"random scene {seed}")


def _draw_size(rng: np.random.Generator, kind: str) -> tuple[float, float, float]:
    if kind == "can":
        return (0.066, 0.066, 0.115)
    a, b = (round(float(edge), 3) for edge in rng.uniform(0.04, 0.07, size=2))
    if kind == "cube":
        return (a, a, a)
    if kind == "cylinder":
        b = a
    # Not taller than twice the narrow side: a slimmer one tips over when a finger touches it first.
    return (a, b, round(float(rng.uniform(0.04, min(0.115, 2.0 * min(a, b)))), 3))


def _place(item: SceneObject) -> str:
    return f"object {item.name!r} at ({', '.join(f'{v:.3f}' for v in item.position)})"


def _off_table(item: SceneObject, table: Table) -> list[str]:
    outline = item.outline()
    low, high = outline.min(axis=0), outline.max(axis=0)
    faults: list[str] = []
    for axis, (edge_low, edge_high) in enumerate((table.x, table.y)):
        over = max(edge_low - low[axis], high[axis] - edge_high)
        if over > _TOUCH:
            faults.append(
                f"{_place(item)} is outside the table: {'xy'[axis]} spans {low[axis]:.3f} .. {high[axis]:.3f} m,"
                f" the table {edge_low:.3f} .. {edge_high:.3f} m"
            )
    bottom = item.centre(table)[2] - item.size[2] / 2.0
    if bottom < table.top_z - _TOUCH:
        faults.append(
            f"{_place(item)} is in the table: its bottom is at z {bottom:.3f}, the top at {table.top_z:.3f} m"
        )
    return faults


def _duplicates(what: str, values: Iterable[str]) -> list[str]:
    twice = [value for value, count in Counter(values).items() if count > 1]
    return [f"{what} {value!r} is used twice; {what}s must be unique in a scene" for value in twice]


def _overlap(a: SceneObject, b: SceneObject, table: Table) -> float:
    """Return how deep two objects overlap, m; 0 when apart. Separating axes of the outlines, and z."""
    outlines = (a.outline(), b.outline())
    edges = np.concatenate([np.roll(outline, -1, axis=0) - outline for outline in outlines])
    normals = np.stack([-edges[:, 1], edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1, keepdims=True)
    spans = [outline @ normals.T for outline in outlines]
    depth = np.minimum(spans[0].max(axis=0), spans[1].max(axis=0)) - np.maximum(
        spans[0].min(axis=0), spans[1].min(axis=0)
    )
    vertical = (a.size[2] + b.size[2]) / 2.0 - abs(a.centre(table)[2] - b.centre(table)[2])
    return max(0.0, min(float(depth.min()), vertical))
