# SPDX-License-Identifier: Apache-2.0
"""Motion of the arms: kinematics, collision checks, planning, timing, and the service that plans and executes.

`kinematics/` `collision/` `planning/` `timing/` are pure functions of an `Arm`; `scene/` holds bodies, held objects and
the map; `service/` decides when an arm may move; `ros/` is the node and its client.

Example:
    >>> from openarm_common import RobotDescription, load_scene
    >>> from openarm_motion import MotionConfig, RequestBoxes, make_arms, table_box, to_named
    >>> robot = RobotDescription.load()
    >>> arms = make_arms(MotionConfig(), robot, [table_box(load_scene("demo").table)])
    >>> start = arms["left"].start_state(dict.fromkeys(robot.joints, 0.0))
    >>> to_named(arms["left"], start, "hands_up", RequestBoxes()).duration > 0.5
    True
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_motion.collision.solids import Box
    from openarm_motion.config import MotionConfig
    from openarm_motion.planning.approach import ApproachRequest, plan_approach
    from openarm_motion.planning.arm import Arm
    from openarm_motion.planning.moves import RequestBoxes, to_named, to_pose
    from openarm_motion.ros.client import MotionClient
    from openarm_motion.service.motion_service import MotionService, make_arms, table_box

__all__ = [
    "ApproachRequest",
    "Arm",
    "Box",
    "MotionClient",
    "MotionConfig",
    "MotionService",
    "RequestBoxes",
    "make_arms",
    "plan_approach",
    "table_box",
    "to_named",
    "to_pose",
]

__getattr__, __dir__ = attach(__name__, __file__)
