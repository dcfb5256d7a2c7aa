# SPDX-License-Identifier: Apache-2.0
"""The controllers of a robot whose motors are commanded by a servo process: its stop is theirs, too."""

from __future__ import annotations

import time
from collections.abc import Callable

from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout
from openarm_control.streamed import StreamedRobot
from openarm_hardware.arm import Phase
from openarm_hardware.driver import MotorDriver

#: The servo has answered a reset after so long, s.
_ANSWER_S = 0.05
_STOPPED = (Phase.REFUSED, Phase.HELD, Phase.DAMPED)


class MotorRobot(StreamedRobot):
    """Runs controllers before a servo process; arguments as `StreamedRobot`."""

    def __init__(
        self,
        controller: RobotController,
        driver: MotorDriver,
        stale_after: float,
        observe: Callable[[JointReadout], None],
        crashed: Callable[[Exception], None] | None = None,
    ) -> None:
        super().__init__(controller, driver, stale_after, observe, crashed)
        self._motors = driver

    def stop_motion(self) -> None:
        """See `ControlLoop.stop_motion`: the motors hold first."""
        self._motors.servo.stop()
        super().stop_motion()

    def release(self) -> str:
        """See `ControlLoop.release`: the motors go on when the cause of a stop is gone."""
        super().release()
        servo = self._motors.servo
        before, end = servo.state(), time.monotonic() + _ANSWER_S
        servo.reset()
        while time.monotonic() < end:
            state = servo.state()
            if state is not None and before is not None and state.cycles > before.cycles + 2:
                return state.text if any(phase in _STOPPED for phase in state.phases) else ""
            time.sleep(0.002)
        return "the process that commands the motors does not answer"
