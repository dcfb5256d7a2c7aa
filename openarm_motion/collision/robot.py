# SPDX-License-Identifier: Apache-2.0
"""Collision shapes of a robot as one of its arms sees them: what moves, and which pairs are worth a check.

Shapes are the primitives of the URDF; pairs that may touch come from the SRDF. m, rad.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, solid_from
from openarm_motion.kinematics.chain import ArmKinematics, ArmLinks


class CollisionRobot:
    """Collision shapes of a robot as seen by one of its arms; built once, shared by all queries.

    Args:
        description: The robot.
        kinematics: The arm that moves.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the arm has no collision shapes, or some that are not primitives.
    """

    def __init__(self, description: RobotDescription, kinematics: ArmKinematics) -> None:
        self.kinematics = kinematics
        self.arm = ArmLinks.of(description, kinematics)
        self.model = pin.buildModelFromXML(description.urdf, True)
        self.geometry = pin.GeometryModel()
        self.links: tuple[str, ...] = tuple(self._add_shapes(description))
        self.moving: tuple[int, ...] = tuple(i for i, link in enumerate(self.links) if link in self.arm.moving)
        if not self.moving:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no link moved by {kinematics.names} has a collision shape")
        self.pairs: tuple[tuple[int, int], ...] = tuple(self._enabled(description))
        # pinocchio searches all pairs for each that it is given: once is enough
        fixed_or_moving = self.arm.fixed | self.arm.moving
        others = tuple(pair for pair in self.pairs if self.links[pair[1]] not in fixed_or_moving)
        self._checked = {own: self._with_pairs(pairs) for own, pairs in ((True, self.pairs), (False, others))}
        self._joint_of = {name: self.model.joints[i] for i, name in enumerate(self.model.names) if i > 0}
        self.joints: tuple[int, ...] = tuple(self.model.getJointId(name) for name in kinematics.names)
        self._columns = np.array([self._joint_of[name].idx_q for name in kinematics.names])
        self._endless = any(self._joint_of[name].nq != 1 for name in kinematics.names)
        self.shape_levers: Array = np.array([self.levers_of(shape) for shape in self.geometry.geometryObjects])
        self.levers: Array = self.shape_levers.max(axis=0)

    def checked(self, own: bool) -> tuple[pin.GeometryModel, list[tuple[int, int]]]:
        """A copy of the shapes with the pairs to check; `own` as in `CollisionContext`."""
        geometry, pairs = self._checked[own]
        return geometry.copy(), [*pairs]

    def configuration(self, state: Mapping[str, float]) -> Array:
        """Full configuration of the model; joints that `state` does not name are at 0, followers follow."""
        q: Array = np.array(pin.neutral(self.model))
        for name, value in state.items():
            if name in self._joint_of:
                self._set(q, name, value)
        return q

    def put(self, full: Array, q: ArrayLike) -> None:
        """Write the arm's joints (n,) into a full configuration."""
        if not self._endless:
            full[self._columns] = q
            return
        for name, value in zip(self.kinematics.names, np.asarray(q, dtype=np.float64), strict=True):
            self._set(full, name, float(value))

    def on_tool(self, boxes: Sequence[Box]) -> list[tuple[int, Box]]:
        """Boxes in the tool frame as `CollisionContext.carried` of the other arm."""
        name = self.kinematics.tool_link
        return [(self.joints[-1], replace(b, id=f"{b.id} at {name}", T=self.kinematics.tip @ b.T)) for b in boxes]

    def _with_pairs(self, pairs: Sequence[tuple[int, int]]) -> tuple[pin.GeometryModel, Sequence[tuple[int, int]]]:
        geometry = self.geometry.copy()
        for i, j in pairs:
            geometry.addCollisionPair(pin.CollisionPair(i, j))
        return geometry, pairs

    def _set(self, full: Array, name: str, value: float) -> None:
        joint = self._joint_of[name]
        if joint.nq == 1:
            full[joint.idx_q] = value
        elif joint.nq == 2:  # pinocchio keeps a continuous joint as cosine and sine
            full[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)

    def levers_of(self, shape: pin.GeometryObject) -> Array:
        """(n,) bounds of how far a point of a shape can be from each joint's axis, m; 1 m/m for a prismatic joint."""
        levers = np.zeros(self.kinematics.n)
        reach = float(np.linalg.norm(shape.placement.translation)) + _half_diagonal(shape.geometry)
        joint = shape.parentJoint
        while joint > 0:
            if joint in self.joints:
                i = self.joints.index(joint)
                levers[i] = 1.0 if self.kinematics.prismatic[i] else reach
            name = self.model.names[joint]
            reach += float(np.linalg.norm(self.model.jointPlacements[joint].translation)) + self._travel.get(name, 0.0)
            joint = self.model.parents[joint]
        return levers

    def _add_shapes(self, description: RobotDescription) -> Iterable[str]:
        self._travel = {
            joint.name: max(abs(joint.lower), abs(joint.upper))
            for joint in description.joints.values()
            if joint.type == "prismatic"
        }
        for link in description.links.values():
            if link.meshes and link.name in self.arm.moving:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT,
                    f"link {link.name!r} has meshes ({', '.join(link.meshes)}); give it boxes, cylinders or spheres",
                )
            frame = self.model.frames[self.model.getFrameId(link.name, pin.FrameType.BODY)]
            for shape in link.collision:
                placement = frame.placement * pin.SE3(shape.T_link_primitive)
                geometry = solid_from(shape.name, shape.T_link_primitive, shape).geometry
                item = pin.GeometryObject(shape.name, frame.parentJoint, placement, geometry)
                self.geometry.addGeometryObject(item)
                yield link.name

    def _enabled(self, description: RobotDescription) -> Iterable[tuple[int, int]]:
        """Pairs of shapes to check: what the SRDF allows to touch is left out; without an SRDF, neighbours are."""
        allowed, body, moving = description.allowed_collisions, self.arm.body, set(self.moving)
        for i in self.moving:
            a = self.links[i]
            for j, b in enumerate(self.links):
                if (j in moving and j <= i) or body[a] == body[b] or frozenset((a, b)) in allowed:
                    continue
                if not description.srdf and frozenset((body[a], body[b])) in self.arm.neighbours:
                    continue
                yield i, j


def _half_diagonal(shape: coal.CollisionGeometry) -> float:
    shape.computeLocalAABB()
    box = shape.aabb_local
    return 0.5 * float(np.linalg.norm(np.asarray(box.max_) - np.asarray(box.min_)))
