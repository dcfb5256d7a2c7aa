# SPDX-License-Identifier: Apache-2.0
"""Read URDF text into frozen data.

Lengths are metres, angles radians; masses, inertias and friction are left to the simulator. ``T_parent_joint`` is the
pose of a joint frame in its parent link, ``T_link_primitive`` the pose of a shape in its
link; a cylinder's axis is its local z.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Literal, cast, get_args

import numpy as np

from openarm_common import se3
from openarm_common.robot.xml_text import attribute, by_name, fault, floats, parse_root
from openarm_common.types import Array

if TYPE_CHECKING:
    from openarm_common.collision.hulls import Hull

Rgba = tuple[float, float, float, float]
JointType = Literal["revolute", "continuous", "prismatic", "fixed"]
ShapeKind = Literal["box", "cylinder", "sphere"]


_SHAPE_TAGS = ("visual", "collision")
#: Attributes that give the size of a shape, each with its number of values.
_SIZES: Mapping[str, Sequence[tuple[str, int]]] = {
    "box": (("size", 3),),
    "cylinder": (("radius", 1), ("length", 1)),
    "sphere": (("radius", 1),),
}


@dataclass(frozen=True, eq=False)
class Primitive:
    """A simple shape on a link.

    Attributes:
        size: box: full edges x, y, z; cylinder: radius, length; sphere: radius.
        corners: (n, 3) in the frame of the shape, None for most. The shape is their convex hull, and what `kind` and
            `size` say is the box about it: all that a reader needs who can do with a larger shape.
        rgba: Colour of a visual, None without one.
    """

    name: str
    kind: ShapeKind
    size: tuple[float, ...]
    T_link_primitive: Array
    rgba: Rgba | None = None
    corners: Array | None = None

    @property
    def half(self) -> Array:
        """(3,) half edges of the box about it, along its own axes, m."""
        if self.kind == "box":
            return 0.5 * np.array(self.size)
        radius = self.size[0]
        return np.array([radius, radius, 0.5 * self.size[1] if self.kind == "cylinder" else radius])

    @property
    def points(self) -> Array:
        """(n, 3) points in its frame whose hull holds it: its corners, or those of the box about it."""
        return self.half * se3.BOX_CORNERS if self.corners is None else self.corners

    @cached_property
    def hull(self) -> Hull | None:
        """Hull of its corners, None for most."""
        from openarm_common.collision.hulls import Hull

        return None if self.corners is None else Hull.of(self.corners)


@dataclass(frozen=True, eq=False)
class VisualMesh:
    """A visual mesh on a link.

    Attributes:
        file: Name in the URDF; absolute, `file://PATH`, in a robot that was read from files.
        scale: Factors of x, y, z; negative ones mirror.
        rgba: Colour, None without one.
    """

    file: str
    scale: tuple[float, ...]
    T_link_mesh: Array
    rgba: Rgba | None = None


@dataclass(frozen=True, eq=False)
class Link:
    """A link.

    Attributes:
        meshes: Visual shapes that are meshes.
        unread: Names of collision shapes that are meshes, of a description that was read without its files.
    """

    name: str
    collision: tuple[Primitive, ...]
    visual: tuple[Primitive, ...]
    meshes: tuple[VisualMesh, ...] = ()
    unread: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint. Its position follows ``multiplier * q[mimic] + offset`` where `mimic` is set.

    Limits are rad and rad/s (m and m/s for a prismatic joint); a continuous joint has infinite ones. Effort is N m (N).
    """

    name: str
    type: JointType
    parent: str
    child: str
    T_parent_joint: Array
    axis: Array
    lower: float
    upper: float
    velocity: float
    effort: float
    mimic: str | None = None
    multiplier: float = 1.0
    offset: float = 0.0

    def motion(self, position: float) -> Array:
        """Pose of the child link in the joint frame, (4, 4)."""
        if self.type == "fixed":
            return np.eye(4)
        if self.type == "prismatic":
            return se3.make(None, self.axis * position)
        return se3.make(se3.exp_so3(self.axis * position))


def parse_urdf(text: str) -> tuple[str, dict[str, Link], dict[str, Joint]]:
    """Read URDF text.

    Returns:
        Robot name, links by name, joints by name.

    Raises:
        OpenArmError: CONFIG_INVALID, naming the element: not XML, a duplicate name, a missing attribute, a joint type
            that is not supported, a joint between links that do not exist.
    """
    root = parse_root(text, "URDF")
    colors = {m.get("name", ""): _rgba(m) for m in root.findall("material")}
    links = by_name("link", ((attribute(element, "name"), _link(element, colors)) for element in root.findall("link")))
    shapes = [shape for tag in _SHAPE_TAGS for shape in root.findall(f"link/{tag}")]
    by_name("visual or collision", ((attribute(shape, "name"), shape) for shape in shapes if "name" in shape.attrib))
    joints = by_name("joint", ((attribute(element, "name"), _joint(element)) for element in root.findall("joint")))
    for joint in joints.values():
        for role, name in (("parent", joint.parent), ("child", joint.child)):
            if name not in links:
                raise fault(f"joint {joint.name!r} has the {role} link {name!r}, which does not exist")
        leader = joints.get(joint.mimic) if joint.mimic is not None else None
        if joint.mimic is not None and (leader is None or leader.mimic is not None or leader.type == "fixed"):
            why = "does not exist" if leader is None else "is fixed or mimics a joint itself"
            way = f"name the one that leads, or give `mimic: {{{joint.name}: {{joint: LEADER}}}}` in --edits of a draft"
            raise fault(f"joint {joint.name!r} mimics {joint.mimic!r}, which {why}; {way}")
    return root.get("name", ""), links, joints


def rewritten(text: str, joints: Iterable[Joint]) -> str:
    """Return URDF text in which joints have the type, origin and limits given; the rest stays as it is.

    Args:
        text: Well-formed URDF.
        joints: Joints of these names in the text.
    """
    root = parse_root(text, "URDF")
    elements = {element.get("name"): element for element in root.findall("joint")}
    for joint in joints:
        element = elements[joint.name]
        element.set("type", joint.type)
        pose = element.find("origin")
        pose = ET.SubElement(element, "origin") if pose is None else pose
        if not np.array_equal(origin(element)[:3, :3], joint.T_parent_joint[:3, :3]):
            pose.set("rpy", " ".join(map(repr, se3.rpy_from_matrix(joint.T_parent_joint[:3, :3]))))
        pose.set("xyz", " ".join(map(repr, joint.T_parent_joint[:3, 3].tolist())))
        limit = element.find("limit")
        if limit is not None and math.isfinite(joint.lower):
            limit.set("lower", repr(joint.lower))
            limit.set("upper", repr(joint.upper))
    return ET.tostring(root, encoding="unicode")


def origin(element: ET.Element) -> Array:
    """Return the pose (4, 4) of a link's shape or of a joint in its parent; the identity where there is none."""
    found = element.find("origin")
    if found is None:
        return np.eye(4)
    roll, pitch, yaw = floats(found.get("rpy", "0 0 0"), 3, found)
    return se3.make(se3.matrix_from_rpy(roll, pitch, yaw), floats(found.get("xyz", "0 0 0"), 3, found))


def _rgba(material: ET.Element) -> Rgba | None:
    color = material.find("color")
    if color is None:
        return None
    r, g, b, a = floats(attribute(color, "rgba"), 4, color)
    return (r, g, b, a)


def _primitive(element: ET.Element, colors: Mapping[str, Rgba | None]) -> Primitive | None:
    geometry = element.find("geometry")
    if geometry is None or len(geometry) != 1:
        raise fault(f"<{element.tag} {element.attrib}>: expected one <geometry> with one shape")
    shape = geometry[0]
    if shape.tag == "mesh":
        return None
    if shape.tag not in _SIZES:
        raise fault(f"<{element.tag} {element.attrib}>: <{shape.tag}> is none of {', '.join(_SIZES)}, mesh")
    kind = cast(ShapeKind, shape.tag)
    size = tuple(value for key, count in _SIZES[kind] for value in floats(attribute(shape, key), count, shape))
    return Primitive(element.get("name", ""), kind, size, origin(element), _colour(element, colors))


def _colour(element: ET.Element, colors: Mapping[str, Rgba | None]) -> Rgba | None:
    """Colour of a shape: its own, or that of the material that it names."""
    material = element.find("material")
    return None if material is None else _rgba(material) or colors.get(material.get("name", ""))


def _link(element: ET.Element, colors: Mapping[str, Rgba | None]) -> Link:
    shapes = {tag: [(shape, _primitive(shape, colors)) for shape in element.findall(tag)] for tag in _SHAPE_TAGS}
    visual, collision = (tuple(one for _, one in found if one is not None) for found in shapes.values())
    meshes = tuple(_mesh(shape, colors) for shape, one in shapes["visual"] if one is None)
    unread = tuple(shape.get("name", shape.tag) for shape, one in shapes["collision"] if one is None)
    return Link(attribute(element, "name"), collision, visual, meshes, unread)


def _mesh(element: ET.Element, colors: Mapping[str, Rgba | None]) -> VisualMesh:
    mesh = element.find("geometry/mesh")
    assert mesh is not None  # `_primitive` has looked
    scale = floats(mesh.get("scale", "1 1 1"), 3, mesh)
    return VisualMesh(mesh.get("filename", ""), tuple(scale), origin(element), _colour(element, colors))


def _child(element: ET.Element, tag: str, key: str) -> str:
    found = element.find(tag)
    if found is None:
        raise fault(f"joint {element.get('name')!r} has no <{tag}>")
    return attribute(found, key)


def _joint(element: ET.Element) -> Joint:
    name = attribute(element, "name")
    kind = attribute(element, "type")
    if kind not in get_args(JointType):
        known = f"joint {name!r} has type {kind!r}; supported: {', '.join(get_args(JointType))}"
        why = '; arms stand on a base that does not move: write type="fixed", or `fixed: [JOINT]` in --edits of a draft'
        raise fault(known + why * (kind in ("planar", "floating")))
    axis_element, limit, mimic = element.find("axis"), element.find("limit"), element.find("mimic")
    if kind == "fixed":  # neither says anything about a joint that does not move
        axis_element = mimic = None
    axis = np.array(
        floats(axis_element.get("xyz", "1 0 0"), 3, axis_element) if axis_element is not None else (1.0, 0.0, 0.0)
    )
    norm = float(np.linalg.norm(axis))
    if norm < 1e-9:
        raise fault(f"joint {name!r} has the axis (0, 0, 0)")
    if kind in ("revolute", "prismatic") and limit is None:
        way = f"write one, or `range: {{{name}: [LOWER, UPPER]}}` in --edits of a draft"
        raise fault(f"joint {name!r} is {kind} and has no <limit>; {way}")

    def number(parent: ET.Element | None, key: str, default: float) -> float:
        text = parent.get(key) if parent is not None else None
        return default if parent is None or text is None else floats(text, 1, parent)[0]

    bounded = kind in ("revolute", "prismatic")
    lower = number(limit, "lower", 0.0) if bounded else -math.inf
    upper = number(limit, "upper", 0.0) if bounded else math.inf
    if lower > upper:
        raise fault(f"joint {name!r} has the lower limit {lower} above the upper limit {upper}")
    return Joint(
        name=name,
        type=kind,  # pyright: ignore[reportArgumentType]
        parent=_child(element, "parent", "link"),
        child=_child(element, "child", "link"),
        T_parent_joint=origin(element),
        axis=axis / norm,
        lower=lower,
        upper=upper,
        velocity=number(limit, "velocity", math.inf),
        effort=number(limit, "effort", math.inf),
        mimic=mimic.get("joint") if mimic is not None else None,
        multiplier=number(mimic, "multiplier", 1.0),
        offset=number(mimic, "offset", 0.0),
    )
