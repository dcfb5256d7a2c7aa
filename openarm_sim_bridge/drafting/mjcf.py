# SPDX-License-Identifier: Apache-2.0
"""From an MJCF to a URDF, by way of the compiled model: bodies become links, of the same names. SI units.

The root link is `world`. What the MJCF fixes to the world is on a base link, whose frame is the world's. A link has the
axes of its body, and its origin on the axis of its joint. What a URDF cannot say is left out: armature, contact
settings, actuators.
"""

from __future__ import annotations

import math
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array
from openarm_sim_bridge.drafting.edits import BoxEdit, Edits, FrameEdit, matches, matching
from openarm_sim_bridge.drafting.mesh_files import MeshFiles

_GEOM, _JOINT = mujoco.mjtGeom, mujoco.mjtJoint
#: Root link of a draft.
WORLD = "world"
_TAGS = ("visual", "collision")
_UNCHANGED = Edits()
#: Places of the components of an inertia.
TENSOR = {"ixx": (0, 0), "ixy": (0, 1), "ixz": (0, 2), "iyy": (1, 1), "iyz": (1, 2), "izz": (2, 2)}
#: A MuJoCo camera looks along -z with y up, an optical frame along z with y down.
_OPTICAL = se3.make(se3.rot_x(math.pi))


def compiled(path: Path, edits: Edits = _UNCHANGED) -> mujoco.MjModel:
    """Compile an MJCF with what is attached to it.

    Raises:
        OpenArmError: CONFIG_INVALID, with what MuJoCo says, or naming a body that is not there.
    """
    if not (edits.prefix or edits.attach or edits.turn or any(edits.stand)):
        try:
            return mujoco.MjModel.from_xml_path(str(path))
        except ValueError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo does not read {path}: {error}") from error
    whole = mujoco.MjSpec()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # options of the solver that differ are nothing a URDF has
            turn = (math.cos(0.5 * edits.turn), 0.0, 0.0, math.sin(0.5 * edits.turn))
            floor = whole.worldbody.add_frame(pos=edits.stand, quat=turn)
            whole.attach(_read(path), prefix=edits.prefix, frame=floor)
            for part in edits.attach:
                body = whole.body(part.body)
                if body is None:
                    raise OpenArmError(Code.CONFIG_INVALID, f"edits.attach: no body {part.body!r} for {part.file}")
                quat = np.roll(se3.quat_xyzw_from_matrix(se3.matrix_from_rpy(*part.rpy)), 1)
                file = path.parent / part.file
                whole.attach(_read(file), prefix=part.prefix, frame=body.add_frame(pos=part.xyz, quat=quat))
            return whole.compile()
    except ValueError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo does not put {path} together: {error}") from error


def _read(path: Path) -> mujoco.MjSpec:
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise OpenArmError(Code.CONFIG_INVALID, f"MuJoCo does not read {path}: {error}") from error
    for mesh in spec.meshes:
        mesh.name = mesh.name or Path(mesh.file).stem  # geoms of an attached part look for the name with its prefix
    return spec


class UrdfDraft:
    """The URDF of a compiled model.

    Args:
        name: Name of the robot.
        model: Its bodies have at most one joint each, a hinge or slide.
        edits: Facts that are not in the MJCF.
        shared: Same as for `MeshFiles`.

    Raises:
        OpenArmError: CONFIG_INVALID, naming each joint that a URDF cannot have, and each name of the edits that the
            model does not have.
    """

    def __init__(self, name: str, model: mujoco.MjModel, edits: Edits, shared: Path | None = None) -> None:
        self._model, self._edits = model, edits
        self._names = [edits.base, *(model.body(k).name or f"body{k}" for k in range(1, model.nbody))]
        self._offsets = np.zeros((model.nbody, 3))
        self._materials: dict[str, ArrayLike] = {}
        given = {name: (edit.joint, edit.multiplier, edit.offset) for name, edit in edits.mimic.items()}
        leaders = {leader for leader, _, _ in given.values()}
        self._mimics = {name: row for name, row in _mimics(model).items() if name not in leaders} | given
        self._refuse()
        self.meshes = MeshFiles(model, shared)
        self._root = ET.Element("robot", name=name)
        ET.SubElement(self._root, "link", name=WORLD)
        self._build()

    def text(self) -> str:
        """Return the URDF."""
        ET.indent(self._root)
        return '<?xml version="1.0"?>\n' + ET.tostring(self._root, encoding="unicode") + "\n"

    def _refuse(self) -> None:
        model, edits, faults = self._model, self._edits, list[str]()
        for body in range(model.nbody):
            first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            if count > 1:
                faults.append(f"body {self._names[body]!r} has {count} joints, expected at most 1")
            for k in range(first, first + count):
                kind, name = int(model.jnt_type[k]), _joint_name(model, k)
                if self._is_fixed(k):
                    pass
                elif kind not in (_JOINT.mjJNT_HINGE, _JOINT.mjJNT_SLIDE):
                    way = f"where the robot stands still, write `fixed: [{name}]` in edits"
                    faults.append(f"joint {name!r} is neither a hinge nor a slide; {way}")
                elif model.qpos0[model.jnt_qposadr[k]] != 0.0:
                    faults.append(f"joint {name!r} has ref {float(model.qpos0[model.jnt_qposadr[k]])}, expected 0")
                elif kind == _JOINT.mjJNT_SLIDE and not self._is_limited(k):
                    way = f"write `range: {{{name}: [LOWER, UPPER]}}` in edits"
                    faults.append(f"joint {name!r} slides without limits; {way}")
                self._offsets[body] = model.jnt_pos[k]
        geoms = {model.geom(k).name for k in range(model.ngeom)}
        geoms |= {f"{name}_{piece:02d}_{tag}" for name in self._names for piece in range(99) for tag in _TAGS}
        faults += [f"edits.replace: no geom {name!r}" for name in edits.replace if name not in geoms]
        joints = {_joint_name(model, k) for k in range(model.njnt)}
        named = {*edits.mimic, *(edit.joint for edit in edits.mimic.values())}
        faults += [f"edits.mimic: no joint {name!r}" for name in sorted(named - joints)]
        for what, links in (("boxes", edits.boxes), ("add", edits.add)):
            faults += [f"edits.{what}: no link {name!r}" for name in links if name not in self._names]
        names = {*self._names, *edits.frames}
        for name, frame in edits.frames.items():
            if frame.parent and frame.parent not in names:
                faults.append(f"edits.frames.{name}: no link {frame.parent!r}")
            for what, kind in (("site", mujoco.mjtObj.mjOBJ_SITE), ("camera", mujoco.mjtObj.mjOBJ_CAMERA)):
                wanted = getattr(frame, what)
                if wanted and mujoco.mj_name2id(model, kind, wanted) < 0:
                    faults.append(f"edits.frames.{name}: no {what} {wanted!r}")
        if faults:
            raise OpenArmError(Code.CONFIG_INVALID, "; ".join(faults))

    def _build(self) -> None:
        model = self._model
        for body, name in enumerate(self._names):
            link = ET.SubElement(self._root, "link", name=name)
            if body:
                self._inertia(link, body)
            if name in self._edits.boxes:
                self._boxes(link, self._edits.boxes[name])
            else:
                self._shapes(link, body)
            for box in self._edits.add.get(name, ()):
                T = se3.make(None, box.xyz)
                shape_element(link, "collision", f"{name}_{box.name}_collision", T, "box", size=_numbers(box.size))
            if body == 0:
                self._fixed(f"{name}_fixed", WORLD, name, np.eye(4))
                continue
            parent = int(model.body_parentid[body])
            T = se3.make(_rotation(model.body_quat[body]), model.body_pos[body])
            T[:3, 3] += T[:3, :3] @ self._offsets[body] - self._offsets[parent]
            if model.body_jntnum[body] and not self._is_fixed(int(model.body_jntadr[body])):
                self._joint(int(model.body_jntadr[body]), self._names[parent], name, T)
            else:
                self._fixed(f"{name}_fixed", self._names[parent], name, T)
        for name, frame in self._edits.frames.items():
            ET.SubElement(self._root, "link", name=name)
            parent, T = self._place(frame)
            self._fixed(f"{name}_fixed", parent, name, T)
        for k, (name, rgba) in enumerate(self._materials.items()):
            material = ET.Element("material", name=name)
            ET.SubElement(material, "color", rgba=" ".join(f"{float(v):.6g}" for v in np.ravel(rgba)))
            self._root.insert(k, material)

    def _is_fixed(self, joint: int) -> bool:
        return matches(self._edits.fixed, _joint_name(self._model, joint))

    def _is_limited(self, joint: int) -> bool:
        return bool(self._model.jnt_limited[joint]) or matches(self._edits.range, _joint_name(self._model, joint))

    def _place(self, frame: FrameEdit) -> tuple[str, Array]:
        """Parent link and pose (4, 4) of a frame."""
        if frame.parent:
            return frame.parent, se3.make(se3.matrix_from_rpy(*frame.rpy), frame.xyz)
        item = self._model.site(frame.site) if frame.site else self._model.camera(frame.camera)
        body = int(item.bodyid[0])
        T = se3.make(_rotation(item.quat), item.pos - self._offsets[body])
        return self._names[body], T if frame.site else T @ _OPTICAL

    def _inertia(self, link: ET.Element, body: int) -> None:
        model = self._model
        R = _rotation(model.body_iquat[body])
        tensor = R @ np.diag(model.body_inertia[body]) @ R.T
        element = ET.SubElement(link, "inertial")
        ET.SubElement(element, "origin", xyz=_numbers(model.body_ipos[body] - self._offsets[body]), rpy="0 0 0")
        ET.SubElement(element, "mass", value=_numbers([model.body_mass[body]]))
        ET.SubElement(element, "inertia", {key: _numbers([tensor[at]]) for key, at in TENSOR.items()})

    def _boxes(self, link: ET.Element, boxes: Iterable[BoxEdit]) -> None:
        for tag in ("visual", "collision"):
            for box in boxes:
                name = f"{link.get('name')}_{box.name}_{tag}"
                element = shape_element(link, tag, name, se3.make(None, box.xyz), "box", size=_numbers(box.size))
                if tag == "visual" and box.material:
                    self._colour(element, box.material, self._edits.materials.get(box.material, (0.5, 0.5, 0.5, 1.0)))

    def _shapes(self, link: ET.Element, body: int) -> None:
        """Visuals, then collision shapes: of geoms that collide with nothing, and of the others."""
        model = self._model
        geoms = [model.geom(k) for k in range(model.ngeom) if model.geom_bodyid[k] == body]
        seen = [not (geom.contype[0] or geom.conaffinity[0]) for geom in geoms]
        hulls = matches(self._edits.hulls, self._names[body])
        for tag, wanted in (("visual", True), ("collision", hulls)):
            found = [geom for geom, is_seen in zip(geoms, seen, strict=True) if is_seen == wanted]
            for piece, geom in enumerate(found):
                name = geom.name or f"{link.get('name')}_{piece:02d}_{tag}"
                if name in self._edits.replace:
                    edit = self._edits.replace[name]
                    if edit is None:
                        continue
                    shape_element(link, tag, edit.name, se3.make(None, edit.xyz), "box", size=_numbers(edit.size))
                    continue
                for element in self._geom(link, tag, name, geom, body):
                    if tag == "visual":
                        material = int(geom.matid[0])
                        rgba = model.mat_rgba[material] if material >= 0 else geom.rgba
                        colour = "rgba_" + "_".join(f"{round(255 * v):02x}" for v in rgba)
                        self._colour(element, model.mat(material).name if material >= 0 else colour, rgba)

    def _geom(self, link: ET.Element, tag: str, name: str, geom: Any, body: int) -> list[ET.Element]:
        """Elements of a geom: one, three of a capsule, none of a plane."""
        kind, (a, b, c) = int(geom.type[0]), (2.0 * float(v) for v in geom.size)
        T = se3.make(_rotation(geom.quat), geom.pos - self._offsets[body])
        if kind == _GEOM.mjGEOM_MESH:
            coarse = not (geom.contype[0] or geom.conaffinity[0])
            mesh = self.meshes.placed(geom, seen=tag == "visual", coarse=coarse)
            T = mesh.T.copy()
            T[:3, 3] -= self._offsets[body]
            size = {"filename": mesh.file}
            if (mesh.signs < 0.0).any():
                size["scale"] = _numbers(mesh.signs)
            return [shape_element(link, tag, name, T, "mesh", **size)]
        if kind == _GEOM.mjGEOM_BOX:
            return [shape_element(link, tag, name, T, "box", size=_numbers([a, b, c]))]
        radius, length = _numbers([0.5 * a]), _numbers([b])
        if kind == _GEOM.mjGEOM_SPHERE:
            return [shape_element(link, tag, name, T, "sphere", radius=radius)]
        if kind not in (_GEOM.mjGEOM_CYLINDER, _GEOM.mjGEOM_CAPSULE):
            if kind == _GEOM.mjGEOM_PLANE:
                return []  # the floor is no part of a robot
            text = (
                f"geom {name!r} is of type {_GEOM(kind).name.removeprefix('mjGEOM_').lower()}, which a URDF cannot have"
            )
            raise OpenArmError(Code.CONFIG_INVALID, text)
        out = [shape_element(link, tag, name, T, "cylinder", radius=radius, length=length)]
        for end in (-0.5 * b, 0.5 * b) if kind == _GEOM.mjGEOM_CAPSULE else ():
            ball = T @ se3.make(None, (0.0, 0.0, end))
            out.append(
                shape_element(link, tag, f"{name}_{'top' if end > 0 else 'bottom'}", ball, "sphere", radius=radius)
            )
        return out

    def _colour(self, element: ET.Element, name: str, rgba: ArrayLike) -> None:
        self._materials.setdefault(name, rgba)
        ET.SubElement(element, "material", name=name)

    def _joint(self, k: int, parent: str, child: str, T: Array) -> None:
        model, name = self._model, _joint_name(self._model, k)
        limited = self._is_limited(k)
        turns = int(model.jnt_type[k]) == _JOINT.mjJNT_HINGE
        kind = ("revolute" if limited else "continuous") if turns else "prismatic"
        element = _joint_element(self._root, name, kind, parent, child, T)
        ET.SubElement(element, "axis", xyz=_numbers(model.jnt_axis[k]))
        ends = matching(self._edits.range, name, tuple(map(float, model.jnt_range[k])))
        limits = dict(zip(("lower", "upper"), ends, strict=True)) if limited else {}
        effort = matching(self._edits.effort, name, _effort(model, k))
        values = {**limits, "effort": effort, "velocity": matching(self._edits.velocity, name, math.inf)}
        # urdfdom reads no joint without the limits of effort and velocity; 0: not known
        known = {key: _numbers([value if math.isfinite(value) else 0.0]) for key, value in values.items()}
        ET.SubElement(element, "limit", known)
        dof = int(model.jnt_dofadr[k])
        damping = matching(self._edits.damping, name, float(model.dof_damping[dof]))
        friction = float(model.dof_frictionloss[dof])
        ET.SubElement(element, "dynamics", damping=_numbers([damping]), friction=_numbers([friction]))
        if name in self._mimics:
            leader, multiplier, offset = self._mimics[name]
            numbers = {"joint": leader, "multiplier": _numbers([multiplier]), "offset": _numbers([offset])}
            ET.SubElement(element, "mimic", numbers)

    def _fixed(self, name: str, parent: str, child: str, T: Array) -> None:
        fixed_joint(self._root, name, parent, child, T)


def fixed_joint(root: ET.Element, name: str, parent: str, child: str, T: Array) -> None:
    """Add a fixed joint to a URDF; `T` (4, 4): of the child in the parent."""
    _joint_element(root, name, "fixed", parent, child, T)


def _joint_name(model: mujoco.MjModel, k: int) -> str:
    return model.joint(k).name or f"{model.body(int(model.jnt_bodyid[k])).name}_joint"


def _effort(model: mujoco.MjModel, k: int) -> float:
    """Limit of a joint's force or torque, N or N m: of the joint, or of its actuators; infinite where there is none."""
    found = [float(np.abs(model.jnt_actfrcrange[k]).max())] if model.jnt_actfrclimited[k] else []
    for a in _actuators(model, k):
        if model.actuator_forcelimited[a]:
            found.append(float(np.abs(model.actuator_forcerange[a]).max() * abs(model.actuator_gear[a, 0])))
    return min(found, default=math.inf)


def _actuators(model: mujoco.MjModel, k: int) -> list[int]:
    of_joints = model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT
    return np.flatnonzero(of_joints & (model.actuator_trnid[:, 0] == k)).tolist()


def _mimics(model: mujoco.MjModel) -> dict[str, tuple[str, float, float]]:
    """Leader, multiplier and offset of each joint that an equality couples; the one with an actuator leads.

    Raises:
        OpenArmError: CONFIG_INVALID, naming a coupling that is not linear.
    """
    found: dict[str, tuple[str, float, float]] = {}
    for k in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT).tolist():
        first, second = int(model.eq_obj1id[k]), int(model.eq_obj2id[k])
        offset, factor, *rest = map(float, model.eq_data[k, :5])
        if second < 0 or factor == 0.0 or any(rest):
            text = f"equality {model.equality(k).name!r} is no linear coupling of two joints"
            raise OpenArmError(Code.CONFIG_INVALID, text)
        if _actuators(model, first) and not _actuators(model, second):
            first, second, factor, offset = second, first, 1.0 / factor, -offset / factor
        found[_joint_name(model, first)] = (_joint_name(model, second), factor, offset)
    return found


def _joint_element(root: ET.Element, name: str, kind: str, parent: str, child: str, T: Array) -> ET.Element:
    element = ET.SubElement(root, "joint", name=name, type=kind)
    set_origin(element, T)
    ET.SubElement(element, "parent", link=parent)
    ET.SubElement(element, "child", link=child)
    return element


def shape_element(link: ET.Element, tag: str, name: str, T: Array, kind: str, **size: str) -> ET.Element:
    """Add a visual or a collision shape to a link, `T` (4, 4) in it, with the attributes of its kind."""
    element = ET.SubElement(link, tag, name=name)
    set_origin(element, T)
    ET.SubElement(ET.SubElement(element, "geometry"), kind, size)
    return element


def set_origin(element: ET.Element, T: Array) -> None:
    """Give a joint or shape its place, (4, 4) in its parent."""
    ET.SubElement(element, "origin", xyz=_numbers(T[:3, 3]), rpy=_numbers(se3.rpy_from_matrix(T[:3, :3])))


def _rotation(quaternion: ArrayLike) -> Array:
    w, x, y, z = np.asarray(quaternion, dtype=np.float64)
    return se3.matrix_from_quat_xyzw([x, y, z, w])


def _numbers(values: ArrayLike) -> str:
    """Numbers as text: as many digits as poses to 1e-12 take, and no -0."""
    return " ".join(f"{round(float(v), 14) + 0.0:.13g}" for v in np.ravel(values))
