# SPDX-License-Identifier: Apache-2.0
"""What a demonstration shows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from openarm_bringup.commands.connect import Robot, Sets
from openarm_evaluation.campaign.options import Seeds


@Parameter(name="*")
@dataclass(frozen=True)
class DemoOptions:
    """What to demonstrate.

    Args:
        seeds: Random scenes one after the other, such as 0-19; in each the first object is grasped.
        label: Object to grasp, in words; the first object of the scene when not given.
        arm: Arm to use.
        place: Place for it: x y z of the footprint centre, base frame, m (z is not read); seeds when not given.
        scene: Name or path of a scene, or "random".
        graph: Name of a graph, or a file.
        video: Pictures and a video; by default for a single grasp only.
        mount_seed: Of the true camera mounts, or "none" for those of the configuration. Mounts of a seed that was never
            calibrated are calibrated first, once.
        uncalibrated: Use the mounts of the configuration, to see what that does.
        domain: ROS_DOMAIN_ID; a free one when not given.
    """

    seeds: Seeds = ()
    label: str | None = None
    arm: str = "auto"
    place: tuple[float, float, float] | None = None
    scene: str | None = None
    graph: str = "sim"
    sets: Sets = ()
    video: Annotated[bool | None, Parameter(negative="--no-video")] = None
    mount_seed: str | None = None
    uncalibrated: bool = False
    domain: int | None = None
    robot: Robot = None

    @property
    def film(self) -> bool:
        """Whether pictures and a video are taken."""
        return not self.seeds if self.video is None else self.video
