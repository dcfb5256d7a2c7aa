# SPDX-License-Identifier: Apache-2.0
"""The map of the robot in this process: the octomap core, fed with the images of its cameras; base frame, m."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.distance_field import CameraMoment, DistanceField
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_octomap.config import OctomapNodeConfig
from openarm_octomap.mapper import Frame, Mapper


class SimulatedMap:
    """Does for one process what the octomap node does; implements `openarm_motion.scene.map_view.FieldSource`.

    Args:
        description: The robot.
        config: Parameters of the octomap node.
        cameras: Cameras by name, at the mounts that the suite believes in.
    """

    def __init__(
        self, description: RobotDescription, config: OctomapNodeConfig, cameras: Mapping[str, CameraConfig]
    ) -> None:
        self.config = config
        self._mapper = Mapper(description, config.grid, config.filter, config.field)
        self._mapper.mount(cameras)
        self._distances = np.empty(self._mapper.lattice.shape, np.float32)
        self._frame = description.root
        self._moments = {name: CameraMoment(0, 0) for name in config.cameras}
        self._field: DistanceField | None = None
        self._next_ns, self._stale = 0, False

    def due(self, t_ns: int) -> bool:
        """Whether it is time for an update."""
        return self.config.field.enabled and t_ns >= self._next_ns

    def update(self, t_ns: int, frames: Sequence[Frame], held: Sequence[HeldBox]) -> None:
        """Put the frames of this moment into the map; none leaves it as it is."""
        self._next_ns = t_ns + round(self.config.period * 1e9)
        if not frames:
            return
        self._mapper.update(frames, held)
        self._stale = True
        self._moments |= {frame.source: CameraMoment(frame.t_ns, t_ns) for frame in frames}
        version = 1 if self._field is None else self._field.version + 1
        self._field = DistanceField(
            self._mapper.lattice,
            self._distances,
            self.config.field.reach,
            self._frame,
            version,
            max(frame.t_ns for frame in frames),
            t_ns,
            dict(self._moments),
        )

    def latest(self) -> DistanceField:
        """Return the newest field.

        Raises:
            OpenArmError: NOT_READY, before the first update.
        """
        if self._field is None:
            raise OpenArmError(Code.NOT_READY, "the map has no version yet")
        if self._stale:  # they take some ms, and only a plan asks for them
            self._mapper.compute_distances(self._distances)
            self._stale = False
        return self._field

    def intact(self, field: DistanceField) -> bool:
        """Whether a field is still the newest: its distances are those of the map."""
        return field is self._field
