# SPDX-License-Identifier: Apache-2.0
"""Vision-guided grasping: strategies that pick and place objects, the evidence they need, and a client of the node.

Example:
    Ask a running graph.

    >>> from openarm_grasp import GraspClient
    >>> with GraspClient() as grasp:  # doctest: +SKIP
    ...     print(grasp.pick("red", place=(0.30, -0.30)).message)

    Carry a request out on any robot that implements `RobotInterface`, without ROS.

    >>> from openarm_grasp import GraspConfig, GraspContext, GraspRequest, GraspSession, Skills, Task, carry_out
    >>> session = GraspSession(GraspContext.of(GraspConfig(), table, description))  # doctest: +SKIP
    >>> task = Task(session, Skills(robot, GraspConfig()), GraspRequest("red"), print)  # doctest: +SKIP
    >>> outcome = await carry_out(task)  # doctest: +SKIP
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_grasp.config import GraspConfig
    from openarm_grasp.context import GraspContext
    from openarm_grasp.robot.interface import RobotInterface
    from openarm_grasp.robot.skills import Skills
    from openarm_grasp.ros.client import GraspClient
    from openarm_grasp.strategies.registry import STRATEGIES, carry_out
    from openarm_grasp.strategies.request import GraspOutcome, GraspRequest
    from openarm_grasp.strategies.states import SUCCESSORS
    from openarm_grasp.strategies.task import GraspSession, Task

__all__ = [
    "STRATEGIES",
    "SUCCESSORS",
    "GraspClient",
    "GraspConfig",
    "GraspContext",
    "GraspOutcome",
    "GraspRequest",
    "GraspSession",
    "RobotInterface",
    "Skills",
    "Task",
    "carry_out",
]

__getattr__, __dir__ = attach(__name__, __file__)
