# SPDX-License-Identifier: Apache-2.0
"""Node `arm_control`: the controllers of this suite before a robot whose driver takes positions alone.

It offers follow_joint_trajectory and gripper_cmd below /arm_control, /joint_commands and the emergency stop, and
streams positions to the driver that make up for weight, friction, damping and latency.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from openarm_common.robot.servos import ServoModel
from openarm_common.ros.node import run
from openarm_control.config import ArmControlConfig
from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout, arm_groups, arm_loads, carriers, gripper_groups, joint_names
from openarm_control.ros.controllers import Controllers
from openarm_control.ros.position_driver import PositionDriver
from openarm_control.ros.process import ControlNode, timely
from openarm_control.servos import KnownServos
from openarm_control.streamed import StreamedRobot

PREFIX = "/arm_control"


class ArmControl(ControlNode[ArmControlConfig]):
    """Carries the arms of a robot behind openarm_ros2."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("arm_control", ArmControlConfig, **kwargs)
        config, description = self.config, self.description
        known: dict[str, ServoModel] = {
            side: config.servos.model(description, load) for side, load in arm_loads(description).items()
        }
        seed = None if config.dynamics_seed < 0 else config.dynamics_seed
        servos = KnownServos(known, config.calibrations, seed, self.get_logger().warning)
        names, effort = joint_names(description), dict[str, float].fromkeys(description.arm_names, np.inf)
        controller = RobotController(
            arm_groups(description),
            gripper_groups(description),
            names,
            JointReadout(0, *np.zeros((3, len(names)))),
            effort,
            config.trajectory,
            config.gripper,
            carriers(description, config.trajectory.carrier, servos.models),
        )
        self._driver = PositionDriver(self, controller, config.topics.arm, config.topics.gripper, PREFIX)
        self._loop = StreamedRobot(controller, self._driver, config.stale_after, self._observe, self.on_crash)
        self._controllers = Controllers(self, self._loop, controller, servos, config.gripper_action, PREFIX)
        self._controller = controller
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        self._loop.start()

    async def hold(self) -> None:
        """End all motions; the arms hold where they are."""
        await self.awaitable(self._loop.call(lambda: self._controller.abort("the node arm_control ends")))

    def close(self) -> None:
        """Stop commanding, then as every node."""
        self._loop.stop()
        self._controllers.destroy()
        self._driver.close()
        super().close()

    def _observe(self, _: JointReadout) -> None:
        self._controllers.publish_states()

    def _report(self) -> None:
        stopped = "the emergency stop is latched" if self._loop.stopped else ""
        fault, period = self._driver.refused or self._loop.fault or stopped, self._loop.periods.figures()
        self.diagnose(
            not fault,
            fault or "running",
            period_p50_ms=f"{period.p50_ms:.2f}",
            period_p99_ms=f"{period.p99_ms:.2f}",
            scheduling=self.scheduling,
            **self._controllers.values(),
        )


def make() -> ArmControl:
    """Make the node for a process of its own."""
    return timely(ArmControl, lambda node: node.config.thread_priority)


def main() -> None:
    """Run the node."""
    run(make)


if __name__ == "__main__":
    main()
