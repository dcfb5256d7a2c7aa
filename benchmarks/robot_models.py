# SPDX-License-Identifier: Apache-2.0
"""Robots of one arm of `models/robots` for tests and benchmarks, and a judge that knows their triangles. m, rad."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance
from openarm_motion.collision.solids import Solid
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm

#: Distances, and turn (rad) and travel (m) between two checks, of paths that keep no distance.
_STEP, _TRAVEL = 0.0125, 0.005
_TOUCHING = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)


@dataclass(frozen=True)
class RobotModel:
    """Postures of a robot of `models/robots`.

    Attributes:
        home: Where motions start, rad.
        start: A bent posture with room around it, rad.
        reach: From the tool's origin to what it is to hold, along z, m.
    """

    home: tuple[float, ...]
    start: tuple[float, ...]
    reach: float = 0.0


ROBOTS: Mapping[str, RobotModel] = {
    "panda": RobotModel(
        home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785), start=(0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8)
    ),
    "ur5e": RobotModel(home=(0.0, -1.57, 0.0, -1.57, 0.0, 0.0), start=(0.0, -1.2, 1.6, -1.9, -1.6, 0.3)),
}


def load_arm(name: str, *, touching: bool = False, endless: str = "") -> Arm:
    """A robot of `ROBOTS` as an arm.

    Args:
        name: Name of the robot.
        touching: Whether paths keep no distance, as in the problems of the literature; lines are checked more finely
            then. False leaves the defaults.
        endless: Joint that turns without end.
    """
    description = RobotDescription.load(name)
    if endless:
        joint = replace(description.joint(endless), type="continuous", lower=-math.inf, upper=math.inf)
        description = description._with_joints(joint)  # pyright: ignore[reportPrivateUsage]
    config = MotionConfig()
    if touching:
        planning = config.planning.model_copy(update={"edge_step": _STEP, "edge_travel": _TRAVEL})
        config = config.model_copy(update={"clearance": _TOUCHING, "planning": planning})
    return Arm(description.arm_names[0], description, config)


class TrueMeshes:
    """A robot by the triangles of its mesh files, with bodies around it; independent of the suite's layers.

    Args:
        name: Name of the robot.
    """

    def __init__(self, name: str) -> None:
        description = RobotDescription.load(name)
        arm = description.arm(description.arm_names[0])
        folder, parts = load_folder(name)
        urdf = str(folder / parts.urdf)
        self._model = pin.buildModelFromUrdf(urdf)
        self._robot = pin.buildGeomFromUrdf(self._model, urdf, pin.GeometryType.COLLISION, package_dirs=[str(folder)])
        self._robot.addAllCollisionPairs()
        pin.removeCollisionPairs(self._model, self._robot, str(folder / parts.srdf))
        self._rows = [self._model.joints[self._model.getJointId(joint)].idx_q for joint in arm.joints]
        self._data = self._model.createData()
        #: Height of the robot's stand, m.
        self.stand = float(description.link_pose(arm.base, {})[2, 3])

    def around(self, obstacles: Sequence[Solid], margin: float = 0.0) -> Callable[[Array], bool]:
        """Whether a configuration (n,) comes as near as `margin`, m, to itself or obstacles."""
        geometry = self._robot.copy()
        links = [k for k, o in enumerate(geometry.geometryObjects) if o.parentJoint > 0]
        for body in obstacles:
            k = geometry.addGeometryObject(pin.GeometryObject(body.id, 0, pin.SE3(body.T), body.geometry))
            for link in links:
                geometry.addCollisionPair(pin.CollisionPair(link, k))
        data, q = pin.GeometryData(geometry), np.array(pin.neutral(self._model))
        for request in data.collisionRequests:
            request.security_margin = margin

        def hits(configuration: Array) -> bool:
            q[self._rows] = configuration
            return bool(pin.computeCollisions(self._model, self._data, geometry, data, q, True))

        return hits


def states_of(waypoints: Array, step: float) -> Array:
    """States (m, n) on straight joint lines between way points (k, n), no joint further than a step apart, rad."""
    rows = [waypoints[:1]]
    for a, b in itertools.pairwise(waypoints):
        count = max(int(np.ceil(np.max(np.abs(b - a)) / step)), 1)
        rows.append(a + np.linspace(0.0, 1.0, count + 1)[1:, None] * (b - a))
    return np.concatenate(rows)
