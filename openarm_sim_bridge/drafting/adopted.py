# SPDX-License-Identifier: Apache-2.0
"""The URDF of a draft from its maker's URDF or xacro, with all meshes that it names in one folder. m, rad."""

from __future__ import annotations

import copy
import shutil
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.convex import convex_parts
from openarm_common.robot.meshes import is_convex, mesh_file, read_mesh
from openarm_common.robot.xacro_files import description_text
from openarm_common.robot.xml_text import attribute, child, floats, parse_root
from openarm_sim_bridge.drafting.collisions import coarse_hull
from openarm_sim_bridge.drafting.edits import Edits, matches, matching
from openarm_sim_bridge.drafting.mesh_files import MOST, is_binary_stl, simplified, write_stl

_PARTS = ("link", "joint", "material", "mujoco")
_TAGS = ("visual", "collision")
#: What edits can say of a URDF.
_OF_URDF = ("range", "velocity", "effort", "mimic", "fixed", "hulls", "base", "stand", "turn")
#: Links that a remark names.
_NAMED = 6
#: Colour of what has a texture.
_GREY = "0.5 0.5 0.5 1"


class AdoptedUrdf:
    """A maker's URDF that depends on no file out of its folder, with a name of its own for each shape.

    Visual meshes become files that MuJoCo reads, collision meshes few convex hulls. Textures are left out, and what is
    of other programs, such as `ros2_control`; so is a branch that is fixed to a link which the file does not have, and
    a visual mesh that is not there: the link then shows its collision shapes.

    Args:
        source: URDF, or xacro.
        folder: Folder of the draft.
        edits: Edits of joints and `hulls`; where the robot stands is added by the draft.
        arguments: Arguments of xacro, by name.
        packages: Folders of packages by name.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for edits and arguments that are none of this file; CONFIG_INVALID, when a file
            is missing or faulty.
    """

    def __init__(
        self, source: Path, folder: Path, edits: Edits, arguments: Mapping[str, str], packages: Mapping[str, Path]
    ) -> None:
        if other := sorted(edits.model_fields_set - set(_OF_URDF)):
            text = f"edits {', '.join(other)} are of an MJCF; those of a URDF are {', '.join(_OF_URDF)}"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        self._source, self._folder, self._packages = source, folder, packages
        self._copies: dict[tuple[Path, tuple[float, ...]], tuple[str, ...]] = {}
        self._names: set[str] = set()
        self._root = parse_root(description_text(source, arguments, packages), str(source))
        for element in list(self._root):
            if element.tag not in _PARTS:
                self._root.remove(element)
        #: Branches that are left out, a sentence each.
        self.remarks = _without_orphans(self._root)
        for compiler in self._root.findall("mujoco/compiler"):
            compiler.attrib.pop("meshdir", None)
        for material in self._root.iter("material"):
            for texture in material.findall("texture"):
                material.remove(texture)
                child(material, "color").attrib.setdefault("rgba", _GREY)
        self._change_joints(edits)
        self.remarks += self._without_lost_meshes(edits)
        for tag in _TAGS:
            for link in self._root.findall("link"):
                self._take_meshes(link, tag)
        self._name_shapes()

    def text(self) -> str:
        """Return the URDF."""
        ET.indent(self._root)
        return ET.tostring(self._root, encoding="unicode") + "\n"

    def _change_joints(self, edits: Edits) -> None:
        for joint in self._root.findall("joint"):
            name = joint.get("name", "")
            if matches(edits.fixed, name):
                joint.set("type", "fixed")
            if joint.get("type") not in ("revolute", "continuous", "prismatic"):
                continue
            if follow := matching(edits.mimic, name, None):
                child(joint, "mimic").attrib = {key: str(value) for key, value in follow.model_dump().items()}
            span = matching(edits.range, name, None)
            said = {key: matching(getattr(edits, key), name, None) for key in ("velocity", "effort")}
            if span is not None:
                said |= {"lower": span[0], "upper": span[1]}
                joint.set("type", "prismatic" if joint.get("type") == "prismatic" else "revolute")
            values = {key: f"{value:.13g}" for key, value in said.items() if value is not None}
            if values or joint.find("limit") is not None:
                # urdfdom reads no joint without the limits of effort and velocity; 0: not known
                limit = child(joint, "limit")
                limit.attrib = {"effort": "0", "velocity": "0"} | limit.attrib | values

    def _without_lost_meshes(self, edits: Edits) -> tuple[str, ...]:
        """Take out visual meshes that are not there, and give links of `hulls` their visuals to collide with."""
        lost: list[str] = []
        bare: list[str] = []
        for link in self._root.findall("link"):
            name = attribute(link, "name")
            for shape in link.findall("visual") if link.find("collision") is not None else ():
                mesh = shape.find("geometry/mesh")
                if mesh is not None and not self._is_there(mesh):
                    lost.append(mesh.get("filename", ""))
                    link.remove(shape)
                    if link.find("visual") is None:
                        _copy_shapes(link, "collision", "visual")
            if matches(edits.hulls, name):
                for shape in link.findall("collision"):
                    link.remove(shape)
                _copy_shapes(link, "visual", "collision")
            if link.find("visual") is not None and link.find("collision") is None:
                bare.append(name)
        remarks: list[str] = []
        if lost:
            what = f"left out visual meshes that are not there: {', '.join(dict.fromkeys(lost))}"
            remarks.append(f"{what}; a link that has no other shows its collision shapes")
        if bare:
            way = "`hulls: [LINK]` in --edits of a new draft gives them hulls of what is seen"
            more = f" and {len(bare) - _NAMED} more" if len(bare) > _NAMED else ""
            remarks.append(f"links that are seen and collide with nothing: {', '.join(bare[:_NAMED])}{more}; {way}")
        return tuple(remarks)

    def _is_there(self, mesh: ET.Element) -> bool:
        try:
            mesh_file(mesh.get("filename", ""), self._source, self._packages)
        except OpenArmError:
            return False
        return True

    def _take_meshes(self, link: ET.Element, tag: str) -> None:
        for shape in link.findall(tag):
            mesh = shape.find("geometry/mesh")
            if mesh is None:
                continue
            path = mesh_file(mesh.get("filename", ""), self._source, self._packages)
            if tag == "visual":
                mesh.set("filename", self._seen(path))
                continue
            scale = floats(mesh.get("scale", "1 1 1"), 3, mesh)
            files = self._hulls(path, scale)
            if (path, ()) in self._copies and files == self._copies[path, ()]:
                mesh.set("filename", files[0])
                continue
            mesh.attrib.pop("scale", None)
            for number, file in enumerate(files):
                part = shape if number == 0 else copy.deepcopy(shape)
                found = part.find("geometry/mesh")
                assert found is not None  # it is a copy of what has one
                found.set("filename", file)
                if number:
                    link.insert(list(link).index(shape) + number, part)

    def _seen(self, path: Path) -> str:
        """Take the file of a visual mesh as it is, or as STL; returns its name in the folder."""
        if (path, ()) not in self._copies:
            file = self._file("visual", path.stem)
            if is_binary_stl(path):
                shutil.copyfile(path, self._folder / file)
            else:
                write_stl(self._folder / file, *simplified(*read_mesh(path, np.ones(3)), MOST))
            self._copies[path, ()] = (file,)
        return self._copies[path, ()][0]

    def _hulls(self, path: Path, scale: tuple[float, ...]) -> tuple[str, ...]:
        """Take a collision mesh, m: the file that is seen where it is convex, or the files of its hulls."""
        if (path, scale) not in self._copies:
            vertices, triangles = read_mesh(path, np.array(scale))
            convex = is_convex(vertices, triangles)
            if convex and (path, ()) in self._copies:
                files = list(self._copies[path, ()])
            else:
                parts = [np.unique(vertices, axis=0)] if convex else convex_parts(vertices, triangles)
                stems = [path.stem if len(parts) == 1 else f"{path.stem}_{k}" for k in range(len(parts))]
                files = [self._file("collision", stem) for stem in stems]
                for file, corners in zip(files, parts, strict=True):
                    write_stl(self._folder / file, *coarse_hull(corners))
            self._copies[path, scale] = tuple(files)
        return self._copies[path, scale]

    def _file(self, tag: str, stem: str) -> str:
        """Return a name that no other mesh has."""
        names = (stem if not k else f"{stem}_{k}" for k in range(len(self._names) + 1))
        name = next(name for name in names if f"{tag}/{name}".lower() not in self._names)
        self._names.add(f"{tag}/{name}".lower())
        path = self._folder / "meshes" / tag / f"{name}.stl"
        path.parent.mkdir(parents=True, exist_ok=True)
        return str(path.relative_to(self._folder))

    def _name_shapes(self) -> None:
        seen: set[str] = set()
        for link in self._root.findall("link"):
            for tag in _TAGS:
                for piece, shape in enumerate(link.findall(tag)):
                    name = shape.get("name") or f"{link.get('name')}_{piece:02d}_{tag}"
                    shape.set("name", name if name not in seen else f"{name}_{len(seen)}")
                    seen.add(shape.get("name", ""))


def _without_orphans(root: ET.Element) -> tuple[str, ...]:
    """Take out branches that are fixed to a link which is not there; returns a sentence for each."""
    remarks: list[str] = []
    links = {link.get("name", ""): link for link in root.findall("link")}
    for joint in root.findall("joint"):
        parent = _link(joint, "parent")
        if joint.get("type") != "fixed" or parent in links:
            continue
        branch, joints = [_link(joint, "child")], [joint]
        for link in branch:
            below = [other for other in root.findall("joint") if _link(other, "parent") == link and other not in joints]
            joints += below
            branch += [_link(other, "child") for other in below]
        left_out = [*joints, *(links[link] for link in branch if link in links)]
        for element in [one for one in root if one in left_out]:
            root.remove(element)
        what = f"joint {joint.get('name')!r} fixes it to {parent!r}, which the file does not have"
        remarks.append(f"left out {', '.join(branch)}: {what}")
    return tuple(remarks)


def _copy_shapes(link: ET.Element, tag: str, to: str) -> None:
    """Give a link the shapes of one tag under another one too."""
    for shape in link.findall(tag):
        part = copy.deepcopy(shape)
        part.tag = to
        part.attrib.pop("name", None)
        link.append(part)


def _link(joint: ET.Element, role: str) -> str:
    element = joint.find(role)
    return "" if element is None else attribute(element, "link")
