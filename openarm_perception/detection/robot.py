# SPDX-License-Identifier: Apache-2.0
"""Which pixels of an image show the robot or what it holds. Usable without ROS."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from pydantic import Field

from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.camera.depth_view import DepthView
from openarm_common.camera.housings import with_housings
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.held import HeldBox
from openarm_common.robot.self_filter import SelfFilter, SelfFilterConfig
from openarm_perception.detection.detector import Mask


class RobotConfig(SelfFilterConfig):
    """How the robot is distinguished from objects; narrow, so that an object between the fingers is kept."""

    padding: float = Field(default=0.005, ge=0.0, le=0.2, description="around every link, m")
    held_padding: float = Field(default=0.01, ge=0.0, le=0.2, description="around what a hand holds, m")


class CloudRobotConfig(RobotConfig):
    """The same for clouds, which are published without delay unless the robot must be cut out."""

    enabled: bool = Field(default=False, description="cut the robot and what it holds out of the clouds")


class RobotFinder:
    """Finds the robot, with the housings of its cameras, in depth images.

    Args:
        description: The robot.
        config: Paddings.
    """

    def __init__(self, description: RobotDescription, config: SelfFilterConfig) -> None:
        self._description, self._config = description, config
        self.mount(load_cameras())

    def mount(self, cameras: Mapping[str, CameraConfig]) -> None:
        """Find the housings of cameras, by name, at these mounts from now on."""
        self._filter = SelfFilter(with_housings(self._description, cameras.values()), self._config)

    def find(
        self, view: DepthView, joints: Mapping[str, float], held: Sequence[HeldBox] = ()
    ) -> tuple[Mask, dict[str, int]]:
        """Find the robot in an image.

        Args:
            view: The image, and the pose of its camera at its stamp.
            joints: Positions at that stamp by joint name, rad or m.
            held: Boxes that the hands hold.

        Returns:
            (h, w) pixels whose point lies in a link or in what is held, and their numbers by link or `held/NAME`.

        Raises:
            OpenArmError: INVALID_ARGUMENT, for a joint without a position; NO_TRANSFORM, for something held by an
                unknown link.
        """
        label, removed = self._filter.label_depth(view, self._filter.shapes(joints, held))
        return label == 1, removed
