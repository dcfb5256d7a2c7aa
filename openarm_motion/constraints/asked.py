# SPDX-License-Identifier: Apache-2.0
"""What plans are asked for with constraints: a configuration in a region, or the tool along straight lines."""

from __future__ import annotations

from dataclasses import dataclass, field

from openarm_common.types import Array
from openarm_motion.constraints.regions import TaskRegion


@dataclass(frozen=True, eq=False)
class RegionGoal:
    """Any of several regions.

    Attributes:
        regions: Any of them will do.
        path: Constraints on every configuration of the path.
        time_limit: Time limit of the search, s; 0: the default.
    """

    regions: tuple[TaskRegion, ...]
    path: TaskRegion = field(default_factory=TaskRegion)
    time_limit: float = 0.0


@dataclass(frozen=True, eq=False)
class CartesianGoal:
    """Poses of the tool, joined by straight lines.

    Attributes:
        waypoints: (4, 4) each, base frame; the present pose comes first.
        max_step: Way of the tool between two points of the trajectory, m; 0: as the sampling period has it.
        revolute_jump: A joint that changes by more than this between two points ends the path, rad; 0: 0.2 rad.
        jump_factor: A change of the joints that is so many times the average one ends the path; 0: none does.
        avoid_collisions: True to end the path where something collides.
        path: Constraints whose violation ends the path.
    """

    waypoints: tuple[Array, ...]
    max_step: float = 0.0
    revolute_jump: float = 0.0
    jump_factor: float = 0.0
    avoid_collisions: bool = True
    path: TaskRegion = field(default_factory=TaskRegion)
