# SPDX-License-Identifier: Apache-2.0
"""Collision shapes of a robot as one of its arms sees them: what moves, and which pairs are worth a check.

Shapes are the primitives of the URDF and the hulls of its meshes; pairs that may touch come from the SRDF, or are
found. m, rad.
"""

from __future__ import annotations

import logging
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from openarm_common.collision.self_collision import always_touching
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.tree import KinematicTree
from openarm_common.types import Array
from openarm_motion.collision.solids import Box, Solid, solid_from
from openarm_motion.kinematics.chain import ArmKinematics, ArmLinks

_LOG = logging.getLogger(__name__)


class CollisionRobot:
    """Collision shapes of a robot as seen by one of its arms; built once, shared by all queries.

    `pairs` are those of shapes to check; `touching` names the links that are not checked since they always touch.

    Args:
        description: The robot.
        kinematics: The arm that moves.
        apart: Least distances, m, of links that the design holds apart (`held_apart`): no more is asked of them.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when the arm has no collision shapes, or some that are not primitives.
    """

    def __init__(
        self,
        description: RobotDescription,
        kinematics: ArmKinematics,
        apart: Mapping[frozenset[str], float] = MappingProxyType({}),
    ) -> None:
        self.kinematics, self.apart = kinematics, apart
        self.arm = ArmLinks.of(description, kinematics)
        self.model = _model_of(description)
        self.geometry = pin.GeometryModel()
        self.links, self.solids = self._add_shapes(description)
        self.moving: tuple[int, ...] = tuple(i for i, link in enumerate(self.links) if link in self.arm.moving)
        if not self.moving:
            raise OpenArmError(Code.INVALID_ARGUMENT, f"no link moved by {kinematics.names} has a collision shape")
        self._joint_of = {name: self.model.joints[i] for i, name in enumerate(self.model.names) if i > 0}
        self.joints: tuple[int, ...] = tuple(self.model.getJointId(name) for name in kinematics.names)
        mine = [self._joint_of[name] for name in kinematics.names]
        self._columns = np.array([joint.idx_q for joint in mine])
        #: Columns of the cosines of those that turn without end, which pinocchio keeps as cosine and sine.
        self._cosines = np.array([joint.idx_q for joint in mine if joint.nq == 2], np.int64)
        self.pairs, self.touching = self._pairs_to_check(description)
        # pinocchio searches all pairs for each that it is given: once is enough
        fixed_or_moving = self.arm.fixed | self.arm.moving
        others = tuple(pair for pair in self.pairs if self.links[pair[1]] not in fixed_or_moving)
        self._checked = {own: self._with_pairs(pairs) for own, pairs in ((True, self.pairs), (False, others))}
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
        full[self._columns] = q
        if self._cosines.size:
            angles = full[self._cosines]
            full[self._cosines], full[self._cosines + 1] = np.cos(angles), np.sin(angles)

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

    def _add_shapes(self, description: RobotDescription) -> tuple[tuple[str, ...], tuple[Solid, ...]]:
        """Link and body of each shape; bodies in the frames of their links."""
        self._travel = {
            joint.name: max(abs(joint.lower), abs(joint.upper))
            for joint in description.joints.values()
            if joint.type == "prismatic"
        }
        links: list[str] = []
        solids: list[Solid] = []
        for link in description.links.values():
            if link.unread and link.name in self.arm.moving:
                raise OpenArmError(
                    Code.INVALID_ARGUMENT,
                    f"link {link.name!r} has meshes ({', '.join(link.unread)}); read it with"
                    " `RobotDescription.from_files`, or give it boxes, cylinders or spheres",
                )
            frame = self.model.frames[self.model.getFrameId(link.name, pin.FrameType.BODY)]
            for shape in link.collision:
                placement = frame.placement * pin.SE3(shape.T_link_primitive)
                solid = solid_from(shape.name, shape.T_link_primitive, shape)
                item = pin.GeometryObject(shape.name, frame.parentJoint, placement, solid.geometry)
                self.geometry.addGeometryObject(item)
                links.append(link.name)
                solids.append(solid)
        return tuple(links), tuple(solids)

    def _enabled(self, description: RobotDescription) -> Iterable[tuple[int, int]]:
        """Pairs of shapes to check, of which at least one moves; fingers of a hand are no matter of its arm."""
        tree, moving = KinematicTree(description), set(self.moving)
        carriers = [self._carrier(shape.parentJoint) for shape in self.geometry.geometryObjects]
        for i in self.moving:
            for j, link in enumerate(self.links):
                if j in moving and (j <= i or carriers[j] == carriers[i]):
                    continue
                if tree.checked(self.links[i], link):
                    yield i, j

    def _carrier(self, joint: int) -> int:
        """Return the last joint of the arm that a joint of the model hangs on, or which it is; 0 without one."""
        while joint > 0 and joint not in self.joints:
            joint = self.model.parents[joint]
        return joint

    def _pairs_to_check(
        self, description: RobotDescription
    ) -> tuple[tuple[tuple[int, int], ...], frozenset[frozenset[str]]]:
        """Pairs of shapes to check, and the pairs of links that are left out since they touch in every sample.

        A pair that is apart in a single sample stays: it is then for the SRDF to say that it may touch.
        """
        pairs = {pair: frozenset((self.links[pair[0]], self.links[pair[1]])) for pair in self._enabled(description)}
        touching = always_touching(description) & frozenset(pairs.values())
        if touching:
            text = ", ".join(sorted(" and ".join(sorted(pair)) for pair in touching))
            _LOG.warning("links that touch in each of many random states are not checked: %s", text)
        return tuple(sorted(pair for pair, links in pairs.items() if links not in touching)), touching


def _half_diagonal(shape: coal.CollisionGeometry) -> float:
    shape.computeLocalAABB()
    box = shape.aabb_local
    return 0.5 * float(np.linalg.norm(np.asarray(box.max_) - np.asarray(box.min_)))


def _model_of(description: RobotDescription) -> pin.Model:
    """Model whose joints come after those that they follow, as pinocchio asks, which goes by their names otherwise."""
    order: dict[str, str] = {}
    for name in sorted(description.joints):
        leader = description.joints[name].mimic
        before = [] if leader is None else [joint.name for joint in description.chain(description.joints[leader].child)]
        for one in (*before, name):
            order.setdefault(one, f"{len(order):06d} {one}")
    root = ET.fromstring(description.urdf)
    for joint in root.findall("joint"):
        joint.set("name", order[joint.get("name", "")])
        for mimic in joint.findall("mimic"):
            mimic.set("joint", order[mimic.get("joint", "")])
    model = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"), True)
    names = {numbered: name for name, numbered in order.items()}
    for i, name in enumerate(model.names):
        model.names[i] = names.get(name, name)
    return model
