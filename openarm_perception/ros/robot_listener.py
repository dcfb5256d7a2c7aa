# SPDX-License-Identifier: Apache-2.0
"""What the nodes know of the robot in view: its posture from /joint_states, and what motion says that it holds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from openarm_common.camera.depth_view import DepthView
from openarm_common.robot.self_filter import SelfFilterConfig
from openarm_common.ros.held_listener import HeldListener
from openarm_common.ros.node import BaseNode
from openarm_perception.detection.detector import Mask
from openarm_perception.detection.robot import RobotFinder


class RobotInView:
    """Finds the robot of a node, and what it holds, in depth images.

    Args:
        node: The node; it listens to what is held from now on (a message a grasp).
        config: Paddings.
        held_topic: Markers on links.
    """

    def __init__(self, node: BaseNode[Any], config: SelfFilterConfig, held_topic: str) -> None:
        self._finder = RobotFinder(node.description, config)
        self._held = HeldListener(node, held_topic)
        #: Pixels of the last image by link or `held/NAME`.
        self.removed: Mapping[str, int] = {}

    def find(self, view: DepthView, joints: Mapping[str, float]) -> Mask:
        """Pixels (h, w) of the robot; arguments and errors as for `RobotFinder.find`."""
        robot, self.removed = self._finder.find(view, joints, self._held.boxes)
        return robot

    def values(self, prefix: str = "") -> dict[str, object]:
        """What /diagnostics says of the last image."""
        return {f"{prefix}removed/{name}": n for name, n in self.removed.items()}
