# SPDX-License-Identifier: Apache-2.0
"""From the robot description and a scene to a MuJoCo model.

The URDF is read by MuJoCo's importer, links and names kept; what a URDF cannot express is added: actuators,
armature, finger coupling, gravity compensation, pad friction, pairs without contact, sites; and what is not the robot:
cameras, table, objects, lights. World frame: x forward, y left, z up; SI units. Geom groups: 0 environment,
1 objects, 2 visual geometry of the robot, 3 its collision geometry (not drawn).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
import numpy as np
from pydantic import Field

from openarm_common.camera.cameras import CameraConfig
from openarm_common.config import Config
from openarm_common.errors import Code, OpenArmError, said
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.lift import LiftParts
from openarm_common.robot.xml_text import child, floats
from openarm_common.scene.scene import Scene
from openarm_sim_bridge.world import scenery
from openarm_sim_bridge.world.appearance import vary
from openarm_sim_bridge.world.hardware import IDEAL, FingerStops, Hardware, drawn
from openarm_sim_bridge.world.touch import add_hand_sensors
from openarm_sim_bridge.world.world import compiled_model

Friction = tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]]

#: Specular and shininess of the materials that are not matt.
_GLOSS = {"silver": (0.45, 0.45), "steel": (0.35, 0.4), "finger_grey": (0.3, 0.4)}
_MATT = (0.12, 0.15)
_COLLISION_GROUP, _VISUAL_GROUP = 3, 2
_NEARLY_NONE = 1e-9


class PhysicsConfig(Config):
    """Solver, contact and finger settings with which grasps hold by friction alone.

    `impratio` and a few no-slip iterations keep a held object from creeping. The finger force is `finger_kp` times the
    remaining travel of a finger, up to `finger_force`, also where a hinge drives it: all of it from a gap of 15 mm on,
    since the motor of a real hand limits its torque whatever the gap. The motors of the arms are `HardwareConfig`.
    """

    timestep: float = Field(
        default=0.002, gt=0.0, le=0.01, description="s; the control tick of 10 ms is a multiple of it"
    )
    integrator: Literal["euler", "implicit", "implicitfast"] = Field(default="implicitfast", description="of MuJoCo")
    cone: Literal["pyramidal", "elliptic"] = Field(default="elliptic", description="friction cone")
    impratio: float = Field(default=10.0, ge=1.0, le=1000.0, description="friction impedance over normal impedance")
    iterations: int = Field(default=100, ge=1, le=1000, description="of the solver, at most")
    noslip_iterations: int = Field(default=4, ge=0, le=100, description="of the no-slip pass")
    jacobian: Literal["dense", "sparse", "auto"] = Field(
        default="dense",
        description="of the constraints; sparse takes less time from eight objects on, but in heaps its solver fails at"
        " times, and what touches flies off",
    )
    sleep: bool = Field(
        default=True, description="whether objects at rest are left out of the physics until something touches them"
    )
    contact_solref: tuple[float, float] = Field(default=(0.005, 1.0), description="time constant (s) and damping ratio")
    contact_solimp: tuple[float, float, float, float, float] = Field(
        default=(0.95, 0.99, 0.001, 0.5, 2.0), description="impedance of contacts and of the finger coupling"
    )
    pad_friction: Friction = Field(
        default=(1.0, 0.01, 0.001), description="finger pads: sliding, torsional (m), rolling (m)"
    )
    pad_condim: Literal[1, 3, 4, 6] = Field(default=4, description="contact dimensions of the pads")
    object_friction: Friction = Field(
        default=(0.8, 0.005, 0.0001), description="objects, table: sliding, torsional, rolling"
    )
    object_condim: Literal[1, 3, 4, 6] = Field(default=4, description="contact dimensions of objects")
    finger_kp: float = Field(default=4000.0, gt=0.0, description="N/m")
    finger_kv: float = Field(default=60.0, ge=0.0, description="N s/m")
    finger_force: float = Field(default=30.0, gt=0.0, description="N; each pad presses with half of it")


def build_spec(
    description: RobotDescription,
    scene: Scene,
    cameras: Mapping[str, CameraConfig],
    mount_seed: int | None = None,
    physics: PhysicsConfig | None = None,
    robot: mujoco.MjSpec | None = None,
) -> mujoco.MjSpec:
    """Compose the world.

    Args:
        description: The robot, from `RobotDescription.load()`.
        scene: Table and objects.
        cameras: Cameras by name; mounts with an error are placed by `mount_seed`.
        mount_seed: Seed of the mount errors; None is the nominal mounts.
        physics: None is the defaults.
        robot: Result of `robot_spec` with the same physics, which saves reading the URDF; not changed.

    Returns:
        An editable model: bodies are named like links, joints and actuators like joints, objects by their names.

    Raises:
        OpenArmError: CONFIG_INVALID, when the parent of a camera or a fixture is not a link, or MuJoCo does not read
            the URDF or a fixture.
    """
    settings = physics or PhysicsConfig()
    spec = robot_spec(description, settings) if robot is None else robot.copy()
    contact: dict[str, Any] = {
        "friction": settings.object_friction,
        "solref": settings.contact_solref,
        "solimp": settings.contact_solimp,
    }
    scenery.add_environment(spec, contact)
    scenery.add_table(spec, scene.table, contact)
    if scene.appearance is not None:
        vary(spec, scene.table, scene.appearance)
    for item in scene.objects:
        scenery.add_object(spec, item, scene.table, contact, settings.object_condim)
    for fixture in scene.fixtures:
        scenery.add_fixture(spec, fixture)
    scenery.add_cameras(spec, cameras.values(), mount_seed)
    return spec


def compile_model(
    description: RobotDescription,
    scene: Scene,
    cameras: Mapping[str, CameraConfig],
    mount_seed: int | None = None,
    physics: PhysicsConfig | None = None,
) -> mujoco.MjModel:
    """Compose and compile the world; arguments and errors as `build_spec`."""
    return compiled_model(build_spec(description, scene, cameras, mount_seed, physics))


def robot_spec(
    description: RobotDescription, physics: PhysicsConfig, hardware: Hardware | None = None
) -> mujoco.MjSpec:
    """Make the model of the robot alone, with actuators and contact settings.

    Joint damping, and dry friction where the hardware has none of its own, come from the URDF, force limits of the arms
    from its efforts.

    Args:
        description: The robot.
        physics: Solver, contacts, fingers.
        hardware: Motors and masses of the arms; None is the ideal ones.

    Raises:
        OpenArmError: CONFIG_INVALID, when MuJoCo does not read the URDF.
    """
    hardware = hardware or drawn(IDEAL, description)
    spec = import_urdf(description)
    set_options(spec, physics)
    for side in description.arm_names:
        _actuate_arm(spec, description, side, hardware)
        _actuate_gripper(spec, description, side, physics, hardware.fingers.get(side))
    if description.lift is not None:
        _actuate_lift(spec, description, description.lift)
    for body in spec.bodies:
        if body.name in hardware.mass:
            # MuJoCo looks at no body's compensation where all are 0 at first; faults change it later
            body.gravcomp = max(hardware.gravity_compensation, _NEARLY_NONE)
            body.mass *= hardware.mass[body.name]
            body.inertia = np.asarray(body.inertia) * hardware.mass[body.name]
            body.fullinertia = np.asarray(body.fullinertia) * hardware.mass[body.name]  # NaN where it is not in use
    for pair in sorted(sorted(pair) for pair in description.allowed_collisions):
        spec.add_exclude(name=" ".join(pair), bodyname1=pair[0], bodyname2=pair[1])
    return spec


def import_urdf(description: RobotDescription) -> mujoco.MjSpec:
    """Make the model of the robot alone, without actuators.

    Raises:
        OpenArmError: CONFIG_INVALID, when MuJoCo does not read the URDF.
    """
    root = ET.fromstring(description.urdf)
    assets = _take_files(root)
    # By default the importer merges links that are fixed to each other, with their names, and drops visual geometry.
    compiler = child(child(root, "mujoco"), "compiler")
    compiler.attrib.pop("meshdir", None)  # meshes have other names here
    compiler.attrib |= {"fusestatic": "false", "discardvisual": "false"}
    try:
        spec = mujoco.MjSpec.from_string(ET.tostring(root, encoding="unicode"), assets=assets)
    except ValueError as error:
        raise OpenArmError(
            Code.CONFIG_INVALID, f"MuJoCo does not read the URDF of {description.name!r}: {error}"
        ) from error
    spec.compiler.autolimits = True
    for mesh in spec.meshes:
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # masses are the description's: any will do
    _sort_geoms(spec, root)
    return spec


def name_meshes(root: ET.Element) -> dict[str, Path]:
    """Name mesh files in a URDF as the importer asks for them, one name a file and scale; return the files by name."""
    files, names = dict[str, Path](), dict[tuple[str, str], str]()
    for mesh in root.iter("mesh"):
        file, scale = mesh.get("filename", ""), mesh.get("scale", "1 1 1")
        if (file, scale) not in names:
            path = Path(file.removeprefix("file://"))
            names[file, scale] = f"{len(names)}_{path.name}"
            files[names[file, scale]] = path
        mesh.set("filename", names[file, scale])
    return files


def _take_files(root: ET.Element) -> dict[str, bytes]:
    """Read the mesh files of a URDF, as `name_meshes` names them."""
    assets = dict[str, bytes]()
    for name, path in name_meshes(root).items():
        try:
            assets[name] = path.read_bytes()
        except OSError as error:
            raise OpenArmError(Code.CONFIG_INVALID, f"can't read mesh {path}: {said(error)}") from error
    return assets


def set_options(spec: mujoco.MjSpec, physics: PhysicsConfig) -> None:
    """Set time step, solver and contact model of a world."""
    option = spec.option
    for key in ("timestep", "impratio", "iterations", "noslip_iterations"):
        setattr(option, key, getattr(physics, key))
    option.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{physics.integrator.upper()}")
    option.cone = getattr(mujoco.mjtCone, f"mjCONE_{physics.cone.upper()}")
    option.jacobian = getattr(mujoco.mjtJacobian, f"mjJAC_{physics.jacobian.upper()}")


def _sort_geoms(spec: mujoco.MjSpec, root: ET.Element) -> None:
    """Sort the geoms into visual and collision geometry, and give materials to the former (URDF has colours only)."""
    colours = {material.get("name", ""): material.find("color") for material in root.findall("material")}
    for shape in root.findall("link/visual"):
        geom = spec.geom(shape.get("name"))
        geom.group, geom.mass = _VISUAL_GROUP, 0.0
        material = shape.find("material")
        name = "" if material is None else material.get("name", "")
        colour = colours.get(name) if material is None or material.find("color") is None else material.find("color")
        if not name or colour is None:
            continue
        if spec.material(name) is None:
            specular, shininess = _GLOSS.get(name, _MATT)
            rgba = floats(colour.get("rgba", ""), 4, colour)
            spec.add_material(name=name, rgba=rgba, specular=specular, shininess=shininess)
        geom.material = name
        geom.rgba = (0.5, 0.5, 0.5, 1.0)  # the default: anything else would override the material
    for shape in root.findall("link/collision"):
        geom = spec.geom(shape.get("name"))
        geom.group, geom.mass = _COLLISION_GROUP, 0.0  # masses are those of the URDF


def _actuate_arm(spec: mujoco.MjSpec, description: RobotDescription, side: str, hardware: Hardware) -> None:
    for name in description.arm_joints(side):
        joint = spec.joint(name)
        joint.armature = hardware.armature[name]
        joint.damping = np.asarray(joint.damping) * hardware.gearbox[name]
        joint.frictionloss = hardware.friction.get(name, joint.frictionloss)
        joint.actfrclimited = False  # one limit is enough: the actuator's
        actuator = _add_servo(
            spec, name, hardware.stiffness[name], hardware.damping[name], description.joints[name].effort
        )
        if description.motors is not None and description.motors.bus is not None:
            actuator.ctrlrange = (-description.motors.bus.position, description.motors.bus.position)
    add_hand_sensors(spec, description.arm(side).hand)
    if hardware.tool_stiffness > 0.0:
        _mount_softly(spec.body(description.arm(side).hand), hardware.tool_stiffness)
    tcp = description.tcp_link(side)
    spec.body(tcp).add_site(name=tcp, size=(0.004, 0.004, 0.004), group=4)


def _actuate_lift(spec: mujoco.MjSpec, description: RobotDescription, lift: LiftParts) -> None:
    joint = description.joints[lift.joint]
    spec.joint(lift.joint).actfrclimited = False
    servo = _add_servo(spec, lift.joint, lift.stiffness, lift.damping, joint.effort)
    servo.ctrlrange = (joint.lower, joint.upper)


def _mount_softly(hand: mujoco.MjsBody, stiffness: float) -> None:
    """Let the hand bend on the wrist about its x and y axes, with half of the critical damping."""
    inertia = 5e-3  # of the hand with an object, about the wrist, kg m2
    for axis in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)):
        hand.add_joint(
            name=f"{hand.name}_flexure_{'xy'[int(axis[1])]}",
            type=mujoco.mjtJoint.mjJNT_HINGE,
            axis=axis,
            stiffness=stiffness,
            damping=math.sqrt(stiffness * inertia),
            armature=inertia,
        )


def _actuate_gripper(
    spec: mujoco.MjSpec, description: RobotDescription, side: str, physics: PhysicsConfig, stops: FingerStops | None
) -> None:
    hand = description.hand(side)
    leader, lever = hand.joint, abs(hand.lever)
    followers = [joint for joint in description.joints.values() if joint.mimic == leader]
    for name in (leader, *(joint.name for joint in followers)):
        joint = spec.joint(name)
        joint.armature = hand.parts.armature
        joint.actfrclimited = False
    if stops is not None:  # followers have no stops of their own
        joint = spec.joint(leader)
        joint.range = sorted(hand.position(finger) for finger in (stops.closed, stops.opened))
        joint.solref_limit, joint.solimp_limit = physics.contact_solref, physics.contact_solimp
        joint.frictionloss = stops.friction * lever
    for finger in description.arm(side).fingers:
        pad = spec.geom(f"{finger}_pad_collision")
        # Priority: the pad's values decide over those of what it touches.
        pad.priority = 1
        pad.friction = physics.pad_friction
        pad.condim = physics.pad_condim
        pad.solref = physics.contact_solref
        pad.solimp = physics.contact_solimp
    kp, kv = physics.finger_kp * lever**2, physics.finger_kv * lever**2
    servo = _add_servo(spec, leader, kp, kv, physics.finger_force * lever)
    servo.ctrlrange = (description.joints[leader].lower, description.joints[leader].upper)
    # The importer couples mimic joints too, but softly: the fingers would drift apart under load.
    names = {joint.name for joint in followers}
    for equality in list(spec.equalities):
        if names & {equality.name1, equality.name2}:
            spec.delete(equality)
    for follower in followers:
        coupling = spec.add_equality(
            name=follower.name,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=follower.name,
            name2=leader,
            solref=physics.contact_solref,
            solimp=physics.contact_solimp,
        )
        polynomial = np.zeros(len(coupling.data))
        polynomial[:2] = follower.offset, follower.multiplier
        coupling.data = polynomial


def _add_servo(spec: mujoco.MjSpec, name: str, kp: float, kv: float, force: float) -> mujoco.MjsActuator:
    """Add a position actuator named like its joint."""
    actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    actuator.set_to_position(kp=kp, kv=kv)
    if math.isfinite(force):
        actuator.forcerange = (-force, force)
    return actuator
