# SPDX-License-Identifier: Apache-2.0
"""Controllers of arms and grippers, which carry a soft arm by position commands alone; `ros/`: their actions.

Example:
    >>> from openarm_common import RobotDescription
    >>> from openarm_control import ServoConfig, arm_loads
    >>> robot = RobotDescription.load()
    >>> ServoConfig().model(robot, arm_loads(robot)["left"]).soft
    True
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_control.arm import TrajectoryConfig as TrajectoryConfig
    from openarm_control.arm import TrajectoryFollower as TrajectoryFollower
    from openarm_control.carrier import Carrier as Carrier
    from openarm_control.controller import RobotController as RobotController
    from openarm_control.gripper import GripperFollower as GripperFollower
    from openarm_control.joints import JointReadout as JointReadout
    from openarm_control.joints import arm_loads as arm_loads
    from openarm_control.loop import ControlLoop as ControlLoop
    from openarm_control.servos import KnownServos as KnownServos
    from openarm_control.servos import ServoConfig as ServoConfig
    from openarm_control.trajectory import JointGroup as JointGroup
    from openarm_control.trajectory import Trajectory as Trajectory

__getattr__, __dir__ = attach(__name__, __file__)
