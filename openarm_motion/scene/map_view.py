# SPDX-License-Identifier: Apache-2.0
"""The map, if it is there and fresh, without the cells that something known explains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from openarm_common.errors import Code, OpenArmError
from openarm_common.octree.distance_field import DistanceField
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.occupancy import OccupancyMap, robot_bodies
from openarm_motion.collision.solids import Solid
from openarm_motion.config import MapConfig
from openarm_motion.planning.failure import PlanFailedError

#: How often a map is read again that was written over meanwhile.
_TRIES = 3


@dataclass(frozen=True)
class MapState:
    """The map as it is now: `occupied` is None where plans go without it, and `why` says so."""

    occupied: OccupancyMap | None
    version: int = 0
    age_s: float = -1.0
    why: str = ""


class FieldSource(Protocol):
    """Where the map comes from: shared memory (`DistanceFieldReader`), or a mapper in this process."""

    def latest(self) -> DistanceField:
        """Return the newest field; NOT_READY when there is none."""
        ...

    def intact(self, field: DistanceField) -> bool:
        """Whether a field is still as it was: ask after using it."""
        ...


class MapView:
    """Reads the map.

    Args:
        config: Settings: whether it is needed, and how old it may be.
        source: Source of its distance fields.
        frames: Names of the base frame; the map must be in it.
    """

    def __init__(self, config: MapConfig, source: FieldSource, frames: Sequence[str]) -> None:
        self._config, self._frames = config, tuple(frames)
        self._reader = source
        self._cells: OccupancyMap | None = None

    def read(self, now_ns: int) -> MapState:
        """The present map.

        Args:
            now_ns: Monotonic time, on the clock of the fields.

        Raises:
            PlanFailedError: NOT_READY or STALE_DATA, with what is missing or how old, when the map is required.
        """
        if self._config.use == "off":
            return MapState(None, why="switched off")
        version, age = 0, -1.0
        try:
            field = self._reader.latest()
            version, age = field.version, (now_ns - field.now_ns) * 1e-9
            field.require_fresh(now_ns, self._config.max_age, self._config.cameras or None)
            if field.frame not in self._frames:
                text = f"the map is in {field.frame!r}, expected {' or '.join(self._frames)}"
                raise OpenArmError(Code.NO_TRANSFORM, text)
            return MapState(self._read(field), version, age)
        except OpenArmError as error:
            if self._config.use == "required":
                text = f"{error.message} (parameter map.use is required)"
                raise PlanFailedError(error.code, text, "scene") from error
            return MapState(None, version, age, error.message)

    def _read(self, field: DistanceField) -> OccupancyMap:
        for _ in range(_TRIES):
            if self._cells is not None and self._cells.version == field.version:
                return self._cells
            cells = OccupancyMap.of(field)
            if self._reader.intact(field):
                self._cells = cells
                return cells
            field = self._reader.latest()
        raise OpenArmError(Code.STALE_DATA, f"the map was written over {_TRIES} times while it was read")


def unexplained(
    occupied: OccupancyMap,
    config: MapConfig,
    robot: RobotDescription,
    state: Mapping[str, float],
    certain: Sequence[Solid],
    estimates: Sequence[Solid],
) -> OccupancyMap:
    """The map without the robot, the bodies of the scene, and those of the request and the hands (base frame)."""
    left = occupied.without(certain, config.certain_padding)
    left = left.without(estimates, config.estimate_padding)
    return left.without(robot_bodies(robot, state), config.robot_padding)
