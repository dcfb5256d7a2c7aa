# SPDX-License-Identifier: Apache-2.0
"""Other robots for tests and benchmarks: where their files are, their arms, and a judge that knows their triangles.

The files are those of the package `example-robot-data` (extra `robots`), or of the folder that the variable
OPENARM_EXAMPLE_ROBOTS of the environment names. m, rad.
"""

from __future__ import annotations

import itertools
import os
import sysconfig
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pinocchio as pin

from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_motion.collision.exact import Clearance
from openarm_motion.collision.solids import Solid
from openarm_motion.config import LimitsConfig, MotionConfig
from openarm_motion.planning.arm import Arm

_PACKAGE = "example-robot-data"
#: Why there are no other robots.
ABSENT = f"{_PACKAGE} is not installed (extra `robots`), and OPENARM_EXAMPLE_ROBOTS does not name its folder"
#: Distances, and turn (rad) and travel (m) between two checks, of paths that keep no distance.
_STEP, _TRAVEL = 0.0125, 0.005
_TOUCHING = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)


@dataclass(frozen=True)
class RobotModel:
    """A robot of the package.

    Attributes:
        urdf: In the folder of robots.
        srdf: In the folder of robots.
        tool: Link that is moved to poses, z out of the hand.
        group: SRDF group.
        limits: Of the joints.
        home: Where motions start, rad.
        start: A bent posture with room around it, rad.
        reach: From the tool's origin to what it is to hold, along z, m.
    """

    urdf: str
    srdf: str
    tool: str
    group: str
    limits: LimitsConfig
    home: tuple[float, ...]
    start: tuple[float, ...]
    reach: float


ROBOTS: Mapping[str, RobotModel] = {
    "panda": RobotModel(
        urdf="panda_description/urdf/panda.urdf",
        srdf="panda_description/srdf/panda.srdf",
        tool="panda_hand_tcp",
        group="panda_arm",
        limits=LimitsConfig(velocity=(2.1,) * 7, acceleration=(7.0,) * 7, jerk=(100.0,) * 7),
        home=(0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785),
        start=(0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8),
        reach=0.0,
    ),
    "ur5": RobotModel(
        urdf="ur_description/urdf/ur5_robot.urdf",
        srdf="ur_description/srdf/ur5.srdf",
        tool="tool0",
        group="manipulator",
        limits=LimitsConfig(velocity=(3.1,) * 6, acceleration=(8.0,) * 6, jerk=(80.0,) * 6),
        home=(0.0, -1.57, 0.0, -1.57, 0.0, 0.0),
        start=(0.0, -1.2, 1.6, -1.9, -1.6, 0.3),
        reach=0.12,
    ),
}


def example_robots() -> Path | None:
    """Folder of the package's data, None when it is not there."""
    given = os.environ.get("OPENARM_EXAMPLE_ROBOTS", "")
    folder = Path(given or Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / _PACKAGE)
    return folder if folder.is_dir() else None


def load_arm(folder: Path, name: str, *, touching: bool = False) -> Arm:
    """A robot of `ROBOTS` as an arm.

    Args:
        folder: See `example_robots`.
        name: Of the robot.
        touching: Whether paths keep no distance, as in the problems of the literature; lines are checked more finely
            then. False leaves the defaults.
    """
    model = ROBOTS[name]
    description = RobotDescription.from_files(
        folder / "robots" / model.urdf, folder / "robots" / model.srdf, {_PACKAGE: folder}
    )
    config = MotionConfig(arms=(name,), tool_link=model.tool, group=model.group, limits=model.limits)
    if touching:
        planning = config.planning.model_copy(update={"edge_step": _STEP, "edge_travel": _TRAVEL})
        config = config.model_copy(update={"clearance": _TOUCHING, "planning": planning})
    return Arm(name, description, config)


class TrueMeshes:
    """A robot by the triangles of its meshes, with boxes and cylinders around it; independent of the suite's layers.

    Args:
        folder: See `example_robots`.
        name: Of the robot.
        names: The arm's joints; others stay at 0.
    """

    def __init__(self, folder: Path, name: str, names: Sequence[str]) -> None:
        urdf, srdf = (str(folder / "robots" / file) for file in (ROBOTS[name].urdf, ROBOTS[name].srdf))
        self._model = pin.buildModelFromUrdf(urdf)
        packages = [str(folder.parent)]
        self._robot = pin.buildGeomFromUrdf(self._model, urdf, pin.GeometryType.COLLISION, package_dirs=packages)
        self._robot.addAllCollisionPairs()
        pin.removeCollisionPairs(self._model, self._robot, srdf)
        self._rows = [self._model.joints[self._model.getJointId(joint)].idx_q for joint in names]
        self._data = self._model.createData()

    def around(self, obstacles: Sequence[Solid]) -> Callable[[Array], bool]:
        """Whether a configuration (n,) hits itself or obstacles."""
        geometry = self._robot.copy()
        links = [k for k, o in enumerate(geometry.geometryObjects) if o.parentJoint > 0]
        for body in obstacles:
            k = geometry.addGeometryObject(pin.GeometryObject(body.id, 0, pin.SE3(body.T), body.geometry))
            for link in links:
                geometry.addCollisionPair(pin.CollisionPair(link, k))
        data, q = pin.GeometryData(geometry), np.array(pin.neutral(self._model))

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
