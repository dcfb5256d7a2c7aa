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
    from openarm_motion.collision.solids import Box as Box
    from openarm_motion.config import MotionConfig as MotionConfig
    from openarm_motion.planning.approach import ApproachRequest as ApproachRequest
    from openarm_motion.planning.approach import plan_approach as plan_approach
    from openarm_motion.planning.arm import Arm as Arm
    from openarm_motion.planning.moves import RequestBoxes as RequestBoxes
    from openarm_motion.planning.moves import to_named as to_named
    from openarm_motion.planning.moves import to_pose as to_pose
    from openarm_motion.ros.client import MotionClient as MotionClient
    from openarm_motion.service.motion_service import MotionService as MotionService
    from openarm_motion.service.motion_service import make_arms as make_arms
    from openarm_motion.service.motion_service import table_box as table_box

__getattr__, __dir__ = attach(__name__, __file__)
