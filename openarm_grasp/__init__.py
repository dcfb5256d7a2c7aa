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
    from openarm_grasp.config import GraspConfig as GraspConfig
    from openarm_grasp.context import GraspContext as GraspContext
    from openarm_grasp.requests.request import GraspOutcome as GraspOutcome
    from openarm_grasp.requests.request import GraspRequest as GraspRequest
    from openarm_grasp.requests.states import SUCCESSORS as SUCCESSORS
    from openarm_grasp.requests.task import GraspSession as GraspSession
    from openarm_grasp.requests.task import Task as Task
    from openarm_grasp.robot.interface import RobotInterface as RobotInterface
    from openarm_grasp.robot.skills import Skills as Skills
    from openarm_grasp.ros.client import GraspClient as GraspClient
    from openarm_grasp.strategies.registry import STRATEGIES as STRATEGIES
    from openarm_grasp.strategies.registry import carry_out as carry_out

__getattr__, __dir__ = attach(__name__, __file__)
