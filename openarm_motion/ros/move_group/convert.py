# SPDX-License-Identifier: Apache-2.0
"""MoveIt's messages to core data and back."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import contextmanager

import numpy as np
from geometry_msgs.msg import Point, Pose
from moveit_msgs.msg import (
    CollisionObject,
    Constraints,
    JointConstraint,
    MoveItErrorCodes,
    OrientationConstraint,
    PositionConstraint,
    RobotState,
    RobotTrajectory,
)
from sensor_msgs.msg import JointState
from shape_msgs.msg import Mesh as MeshMessage
from shape_msgs.msg import MeshTriangle, SolidPrimitive

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import matrix_to_pose, ns_to_stamp, pose_to_matrix, trajectory_to_msg, xyz
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Cylinder, Mesh, Solid, Sphere
from openarm_motion.constraints.names import RobotNames
from openarm_motion.constraints.regions import JointInterval, OrientationRegion, PositionRegion, TaskRegion, Volume
from openarm_motion.ros.move_group.codes import MoveItError
from openarm_motion.timing.trajectory import Motion

#: Brings a pose (4, 4) in a frame to the base frame.
InBase = Callable[[Array, str], Array]

#: Sides of the polygon about the base of a cone.
_CONE_SIDES = 24
_KINDS = {
    SolidPrimitive.BOX: ("box", 3),
    SolidPrimitive.SPHERE: ("sphere", 1),
    SolidPrimitive.CYLINDER: ("cylinder", 2),
}


@contextmanager
def as_moveit(val: int) -> Generator[None, None, None]:
    """Give an error of what is inside a code of MoveIt, but for unknown frames and those that have one."""
    try:
        yield
    except MoveItError:
        raise
    except OpenArmError as error:
        if error.code is Code.NO_TRANSFORM:
            raise
        raise MoveItError(val, error.message, error.code) from error


class Converter:
    """Conversions that need to know the robot.

    Args:
        description: The robot.
        names: Names of its groups and links.
        in_base: Looks frames up.
    """

    def __init__(self, description: RobotDescription, names: RobotNames, in_base: InBase) -> None:
        self._description, self._names, self.in_base = description, names, in_base

    # --- constraints
    def region(self, message: Constraints, arm: str) -> TaskRegion:
        """The region of an arm's configurations that constraints describe.

        Raises:
            MoveItError: INVALID_GOAL_CONSTRAINTS or INVALID_LINK_NAME, saying what is wrong.
        """
        with as_moveit(MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS):
            return TaskRegion(
                tuple(self._interval(joint) for joint in message.joint_constraints),
                tuple(self._position(part, arm) for part in message.position_constraints),
                tuple(self._orientation(part, arm) for part in message.orientation_constraints),
            )

    def regions(self, message: Constraints, arms: Sequence[str]) -> tuple[TaskRegion, ...]:
        """The region of each of the arms of a group; what a constraint is of says which arm it is for.

        Raises:
            MoveItError: as `region`.
        """
        if len(arms) == 1:
            return (self.region(message, arms[0]),)
        parts = {arm: Constraints() for arm in arms}
        with as_moveit(MoveItErrorCodes.INVALID_GOAL_CONSTRAINTS):
            for joint in message.joint_constraints:
                parts[self._names.arm_of_joint(joint.joint_name, arms)].joint_constraints.append(joint)
        with as_moveit(MoveItErrorCodes.INVALID_LINK_NAME):
            for place in message.position_constraints:
                parts[self._names.arm_of_link(place.link_name, arms)].position_constraints.append(place)
            for turn in message.orientation_constraints:
                parts[self._names.arm_of_link(turn.link_name, arms)].orientation_constraints.append(turn)
        return tuple(self.region(part, arm) for arm, part in parts.items())

    def on_tool(self, arm: str, link: str) -> Array:
        """Pose of a link in the frame of an arm's tool.

        Raises:
            MoveItError: INVALID_LINK_NAME.
        """
        with as_moveit(MoveItErrorCodes.INVALID_LINK_NAME):
            return self._names.on_tool(arm, link)

    def _interval(self, message: JointConstraint) -> JointInterval:
        name, joint = message.joint_name, self._description.joints.get(message.joint_name)
        upper = 0.0 if joint is None else joint.upper
        tolerances, weight = (message.tolerance_above, message.tolerance_below), _weight(message.weight, name)
        return JointInterval(name, message.position, *tolerances, weight, upper)

    def _position(self, message: PositionConstraint, arm: str) -> PositionRegion:
        T = self.on_tool(arm, message.link_name)
        shapes, poses = message.constraint_region.primitives, message.constraint_region.primitive_poses
        if not shapes or len(shapes) != len(poses):
            text = f"{len(shapes)} primitives and {len(poses)} primitive_poses, expected as many, at least one"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"position constraint of {message.link_name}: {text}")
        volumes = [
            _volume(shape, self.pose(pose, message.header.frame_id)) for shape, pose in zip(shapes, poses, strict=True)
        ]
        p = T[:3, 3] + T[:3, :3] @ xyz(message.target_point_offset)
        return PositionRegion(message.link_name, p, tuple(volumes), _weight(message.weight, message.link_name))

    def _orientation(self, message: OrientationConstraint, arm: str) -> OrientationRegion:
        T = self.on_tool(arm, message.link_name)
        R = self.pose(Pose(orientation=message.orientation), message.header.frame_id)[:3, :3]
        tolerance = (
            message.absolute_x_axis_tolerance,
            message.absolute_y_axis_tolerance,
            message.absolute_z_axis_tolerance,
        )
        if not np.isfinite(tolerance).all() or min(tolerance) < 0.0:
            text = f"orientation constraint of {message.link_name}: tolerances {tolerance}, expected >= 0 rad"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        if message.parameterization not in (message.XYZ_EULER_ANGLES, message.ROTATION_VECTOR):
            text = f"parameterization is {message.parameterization}; valid: XYZ_EULER_ANGLES 0, ROTATION_VECTOR 1"
            raise OpenArmError(Code.INVALID_ARGUMENT, text)
        vector = message.parameterization == message.ROTATION_VECTOR
        weight = _weight(message.weight, message.link_name)
        return OrientationRegion(message.link_name, T[:3, :3], R, tolerance, vector, weight)

    # --- states
    def state(self, message: RobotState) -> dict[str, float]:
        """Positions of the joints that a robot state names.

        Raises:
            MoveItError: INVALID_ROBOT_STATE, naming the joint.
        """
        names, positions = list(message.joint_state.name), list(message.joint_state.position)
        if len(names) != len(positions):
            text = f"joint_state has {len(names)} names and {len(positions)} positions"
            raise MoveItError(MoveItErrorCodes.INVALID_ROBOT_STATE, text)
        for name, value in zip(names, positions, strict=True):
            if name not in self._description.joints:
                text = f"joint_state names {name!r}; joints: {', '.join(self._movable())}"
                raise MoveItError(MoveItErrorCodes.INVALID_ROBOT_STATE, text)
            if not np.isfinite(value):
                raise MoveItError(MoveItErrorCodes.INVALID_ROBOT_STATE, f"joint_state: {name} is {value}")
        return dict(zip(names, positions, strict=True))

    def _movable(self) -> list[str]:
        return [name for name, joint in self._description.joints.items() if joint.type != "fixed"]

    def pose(self, pose: Pose, frame: str) -> Array:
        """A pose in the base frame.

        Raises:
            OpenArmError: NO_TRANSFORM; INVALID_ARGUMENT, for a quaternion that is none.
        """
        return self.in_base(pose_to_matrix(pose), frame)

    # --- bodies
    def shapes(self, message: CollisionObject) -> tuple[Array, tuple[Solid, ...]]:
        """Pose and shapes of an object, base frame.

        Raises:
            MoveItError: INVALID_OBJECT_NAME, saying what is wrong with it.
        """
        with as_moveit(MoveItErrorCodes.INVALID_OBJECT_NAME):
            T = self.pose(message.pose, message.header.frame_id)
            out: list[Solid] = []
            for what, shapes, poses in (
                ("primitive", message.primitives, message.primitive_poses),
                ("mesh", message.meshes, message.mesh_poses),
            ):
                places = poses or [Pose()] * (len(shapes) if len(shapes) == 1 else 0)
                if len(shapes) != len(places):
                    text = f"object {message.id!r} has {len(shapes)} shapes and {len(poses)} {what}_poses"
                    raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}, expected as many")
                for shape, pose in zip(shapes, places, strict=True):
                    out.append(_solid(message.id, T @ pose_to_matrix(pose), shape))
            return T, tuple(out)


def _weight(given: float, name: str) -> float:
    """The weight of a constraint of a joint or link; 0 is 1, as in MoveIt."""
    if not 0.0 <= given < np.inf:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"constraint of {name}: weight is {given:g}, expected a number >= 0")
    return given or 1.0


def _volume(shape: SolidPrimitive, T: Array) -> Volume:
    if shape.type not in _KINDS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"a region of type {shape.type}; valid: BOX 1, SPHERE 2, CYLINDER 3")
    kind, count = _KINDS[shape.type]
    size = tuple(float(x) for x in shape.dimensions)
    if len(size) != count or not np.isfinite(size).all() or min(size) < 0.0:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"a {kind} of dimensions {list(size)}, expected {count} numbers >= 0")
    return Volume(kind, T, size)  # pyright: ignore[reportArgumentType]


def _solid(id: str, T: Array, shape: SolidPrimitive | MeshMessage) -> Solid:
    if isinstance(shape, MeshMessage):
        return Mesh(id, T, np.array([[v.x, v.y, v.z] for v in shape.vertices], np.float64).reshape(-1, 3))
    size = np.array(shape.dimensions, np.float64)
    wanted = {SolidPrimitive.BOX: 3, SolidPrimitive.SPHERE: 1, SolidPrimitive.CYLINDER: 2, SolidPrimitive.CONE: 2}
    if shape.type not in wanted:
        text = f"object {id!r} has a primitive of type {shape.type}; valid: BOX 1, SPHERE 2, CYLINDER 3, CONE 4"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    if len(size) != wanted[shape.type]:
        text = f"object {id!r} has a primitive of {len(size)} dimensions, expected {wanted[shape.type]}"
        raise OpenArmError(Code.INVALID_ARGUMENT, text)
    if shape.type == SolidPrimitive.BOX:
        return Box(id, T, size)
    if shape.type == SolidPrimitive.SPHERE:
        return Sphere(id, T, float(size[0]))
    if shape.type == SolidPrimitive.CYLINDER:
        return Cylinder(id, T, float(size[1]), float(size[0]))
    return _cone(id, T, float(size[0]), float(size[1]))


def _cone(id: str, T: Array, height: float, radius: float) -> Mesh:
    """A cone about z with its base down, in the pyramid about it; the origin is at half its height."""
    turns = 2.0 * np.pi * np.arange(_CONE_SIDES) / _CONE_SIDES
    r = radius / np.cos(np.pi / _CONE_SIDES)
    base = np.column_stack([r * np.cos(turns), r * np.sin(turns), np.full(_CONE_SIDES, -0.5 * height)])
    return Mesh(id, T, np.vstack([base, [0.0, 0.0, 0.5 * height]]))


# --- to messages
def object_msg(id: str, T: Array, shapes: Sequence[Solid], frame: str, *, geometry: bool = True) -> CollisionObject:
    """Message of a body in a frame; the poses of its shapes are relative to its own."""
    message = CollisionObject(id=id, pose=matrix_to_pose(T), operation=CollisionObject.ADD)
    message.header.frame_id = frame
    for solid in shapes if geometry else ():
        pose = matrix_to_pose(se3.inverse(T) @ solid.T)
        if isinstance(solid, Mesh):
            hull, triangles = solid.hull_mesh
            mesh = MeshMessage(vertices=[Point(x=x, y=y, z=z) for x, y, z in hull.tolist()])
            mesh.triangles = [MeshTriangle(vertex_indices=row) for row in triangles.astype(np.uint32)]
            message.meshes.append(mesh)
            message.mesh_poses.append(pose)
            continue
        message.primitives.append(_primitive(solid))
        message.primitive_poses.append(pose)
    return message


def _primitive(solid: Solid) -> SolidPrimitive:
    if isinstance(solid, Sphere):
        return SolidPrimitive(type=SolidPrimitive.SPHERE, dimensions=[solid.radius])
    if isinstance(solid, Cylinder):
        return SolidPrimitive(type=SolidPrimitive.CYLINDER, dimensions=[solid.length, solid.radius])
    return SolidPrimitive(type=SolidPrimitive.BOX, dimensions=solid.extents.tolist())


def state_msg(state: Mapping[str, float], t_ns: int = 0) -> RobotState:
    """Message of joint positions by name."""
    joints = JointState(name=list(state), position=list(state.values()))
    joints.header.stamp = ns_to_stamp(t_ns)
    return RobotState(joint_state=joints)


def trajectory_msg(motion: Motion | None) -> RobotTrajectory:
    """Message of a trajectory; empty without one."""
    if motion is None:
        return RobotTrajectory()
    return RobotTrajectory(joint_trajectory=trajectory_to_msg(motion.names, motion.t, motion.q, motion.v, motion.a))
