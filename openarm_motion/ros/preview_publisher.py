# SPDX-License-Identifier: Apache-2.0
"""Shows what the latest plan would do, for whoever has to agree to it: latched /motion/preview."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import MarkerArray

from openarm_common.ros.node import BASE_FRAME, QOS_LATCHED, BaseNode
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.ros import convert
from openarm_motion.timing.trajectory import Trajectory

#: Points of a trajectory that are shown.
_POINTS = 50


class PreviewPublisher:
    """See the module's head.

    Args:
        node: Owns the publisher.
        arms: By name.
    """

    def __init__(self, node: BaseNode[MotionConfig], arms: Mapping[str, Arm]) -> None:
        self._arms = arms
        self._publisher = node.create_publisher(MarkerArray, "/motion/preview", QOS_LATCHED)

    def show(self, plans: Mapping[str, Sequence[Trajectory]]) -> None:
        """Show the ways of the tools on the trajectories of each arm, one after the other."""
        ways: dict[str, NDArray[np.float64]] = {}
        for name, parts in plans.items():
            q = np.concatenate([part.at(np.linspace(0.0, part.duration, _POINTS))[0] for part in parts])
            ways[name] = self._arms[name].kinematics.fk_many(q)[:, :3, 3]
        self._publisher.publish(convert.preview_markers(ways, BASE_FRAME))
