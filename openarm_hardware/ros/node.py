# SPDX-License-Identifier: Apache-2.0
"""Node `openarm_hardware`: the motors of a real robot behind the topics and actions of the simulated one.

The motors are commanded by a process of their own (`openarm_hardware.servo`); here are the controllers, at 100 Hz.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from concurrent.futures import Future as ThreadFuture
from typing import Any

import numpy as np

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.errors import OpenArmError
from openarm_common.motors.bus import emulated_buses, open_bus
from openarm_common.motors.wiring import Wiring, axes_of, load_wiring
from openarm_common.pacing import RateDivider
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.servos import ArmLoad, ServoModel
from openarm_common.ros.node import run, until_shutdown
from openarm_control.controller import RobotController
from openarm_control.joints import JointReadout, arm_groups, arm_loads, carriers, gripper_groups, joint_names
from openarm_control.ros.controllers import Controllers
from openarm_control.ros.process import ControlNode, timely
from openarm_control.ros.robot_publisher import RobotPublisher
from openarm_control.servos import KnownServos
from openarm_hardware.arm import UNPLACED, Phase
from openarm_hardware.axis import turn_text
from openarm_hardware.client import ServoProcess
from openarm_hardware.config import HardwareNodeConfig
from openarm_hardware.driver import MotorDriver
from openarm_hardware.exchange import BIN_S, State
from openarm_hardware.loop import MotorRobot
from openarm_hardware.posture import LastPosture
from openarm_hardware.touch import TouchGuard

#: An emulator that starts at the same time has this long, s.
_EMULATOR_S = 30.0
#: Motors that are within this of being too hot are warned of, °C.
_WARM = 10


class OpenArmHardware(ControlNode[HardwareNodeConfig]):
    """The motors with their controllers.

    Raises:
        OpenArmError: CONFIG_INVALID, when the robot's folder does not say where its motors are; ENVIRONMENT or BUSY,
            when a bus can't be opened.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("openarm_hardware", HardwareNodeConfig, **kwargs)
        config, description = self.config, self.description
        wiring, loads = load_wiring(), arm_loads(description)
        sockets = emulated_buses(self.context.get_domain_id(), description.arm_names, config.motor_sockets)
        self._axes = axes_of(wiring, description, sockets if config.emulated else None)
        if config.emulated:
            _await_buses({axis.bus for axis in self._axes}, flexible=wiring.flexible)
        self._settings = config.motors.settings(flexible=wiring.flexible)
        self._posture = LastPosture(config.calibrations, "_emulated" if config.emulated else "")
        self._known = self._posture.read()
        self._turns = dict[str, float]()
        seed = None if config.dynamics_seed < 0 else config.dynamics_seed
        known = {side: _servo_model(config, wiring, description, load) for side, load in loads.items()}
        servos = KnownServos(known, config.calibrations, seed, self.get_logger().warning)
        names = joint_names(description)
        effort = {axis.arm: abs(axis.torque * axis.ratio) for axis in self._axes if axis.grips}
        self._controller = RobotController(
            arm_groups(description),
            gripper_groups(description),
            names,
            JointReadout(0, *np.zeros((3, len(names)))),
            effort,
            config.trajectory,
            config.gripper,
            carriers(description, config.trajectory.carrier, servos.models),
        )
        self._states = RobotPublisher(self, description, names)
        self._tf_ticks = RateDivider(config.tf_rate)
        guard = TouchGuard(SelfCollision(description, names))
        servo = self._start_servo(self._known)
        self._driver = MotorDriver(servo, self._controller, loads, guard, self._publish)
        self._loop = MotorRobot(self._controller, self._driver, config.stale_after, self._observe, self.on_crash)
        self._controllers = Controllers(self, self._loop, self._controller, servos, config.gripper_action)
        self._periods: Sequence[int] = ()
        self._starting: ThreadFuture[None] | None = None
        self._states.publish_static(description)
        self.create_timer(self.REPORT_PERIOD_S, self._report, clock=self.steady_clock)
        self._loop.start()

    async def hold(self) -> None:
        """End all motions; the arms hold where they are until `close` lets them sink."""
        await self.awaitable(self._loop.call(lambda: self._controller.abort("the node openarm_hardware ends")))

    def close(self) -> None:
        """Let the arms sink, switch the motors off, then as every node."""
        self._loop.stop()
        self._controllers.destroy()
        self._driver.servo.close()
        self._store()
        super().close()

    def _start_servo(self, last: dict[str, float]) -> ServoProcess:
        servo = ServoProcess(self._axes, self._settings, last)
        self.get_logger().info(f"motors of {', '.join(dict.fromkeys(a.bus for a in self._axes))}: {servo.scheduling}")
        return servo

    def _publish(self, readout: JointReadout) -> None:
        """Publish a joint state, in the thread of the loop, whether the arms are commanded or not."""
        with until_shutdown(self.context):
            self._states.publish_joints(readout)
            if self._tf_ticks.due(readout.t_ns):
                self._states.publish_tf(readout)

    def _observe(self, _: JointReadout) -> None:
        with until_shutdown(self.context):
            self._controllers.publish_states()

    def _store(self) -> None:
        """Store where the joints are, of arms of which it is known; the others keep what is stored."""
        state = self._driver.state
        if state is None:
            return
        phases = dict(zip(dict.fromkeys(axis.arm for axis in self._axes), state.phases, strict=True))
        rows = [row for row in zip(self._axes, state.motors, strict=True) if phases[row[0].arm] not in UNPLACED]
        self._known |= {axis.joint: motor.q for axis, motor in rows}
        if rows and (why := self._posture.write(self._known)):
            self.get_logger().warning(why, throttle_duration_sec=60.0)
        for axis, motor in rows:
            if motor.turn != self._turns.setdefault(axis.joint, 0.0):
                self._turns[axis.joint] = motor.turn
                self.get_logger().warning(turn_text(axis, motor.q, motor.turn) or f"{axis} lost no turn any more")

    def _report(self) -> None:
        """Report once per second; start the process of the motors again when it has ended."""
        servo, loop = self._driver.servo, self._loop
        if not servo.alive and (self._starting is None or self._starting.done()):
            self.get_logger().error("the process that commands the motors has ended; it is started again")
            self._starting = ThreadFuture()
            self.in_thread(self._restart, self._starting)
        state = servo.state()
        if state is not None:
            self._store()
        stopped = "the emergency stop is latched" if loop.stopped else ""
        fault = loop.fault or stopped
        values = {} if state is None else self._values(state)
        warm = [
            f"{axis} is at {hottest} °C"
            for axis, motor in zip(self._axes, state.motors if state else (), strict=False)
            if (hottest := max(motor.mosfet, motor.rotor)) > self._settings.hot - _WARM
        ]
        values = {"scheduling": servo.scheduling, **values, **self._controllers.values()}
        if warm and not fault:
            self.diagnose_warning("; ".join(warm), **values)
        else:
            self.diagnose(not fault, fault or "running", **values)

    def _restart(self, started: ThreadFuture[None]) -> None:
        old = self._driver.servo
        try:
            self._driver.servo = self._start_servo({})
            old.close()
        except OpenArmError as error:
            self.get_logger().error(f"the motors can't be commanded: {error}")
        finally:
            started.set_result(None)

    def _values(self, state: State) -> dict[str, object]:
        """Return what /diagnostics says of the motors."""
        before = self._periods if sum(self._periods) <= sum(state.periods) else ()
        self._periods = state.periods
        since = np.array(state.periods, dtype=np.int64)
        if len(before) == len(since):
            since = since - np.array(before, dtype=np.int64)
        p50, p99 = percentiles(since)
        arms = list(dict.fromkeys(axis.arm for axis in self._axes))
        found: dict[str, object] = {f"{arm}_phase": Phase(p).name for arm, p in zip(arms, state.phases, strict=True)}
        for axis, motor in zip(self._axes, state.motors, strict=True):
            hottest = max(motor.mosfet, motor.rotor)
            turn = f"; {turn_text(axis, motor.q, motor.turn)}" if motor.turn else ""
            found[axis.joint] = f"status {motor.status:#x}, {hottest} °C, {motor.lost} replies lost{turn}"
        return found | {
            "period_p50_ms": f"{p50 * 1e3:.2f}",
            "period_p99_ms": f"{p99 * 1e3:.2f}",
            "cycles": state.cycles,
            "cycles_left_out": state.late,
            "bus_errors": state.errors,
            "frames_lost": sum(motor.lost for motor in state.motors),
        }


def percentiles(bins: np.ndarray[Any, np.dtype[np.int64]]) -> tuple[float, float]:
    """Return median and 99th percentile of a histogram of periods, s; 0 of an empty one."""
    total = int(bins.sum())
    if total == 0:
        return 0.0, 0.0
    p50, p99 = (int(np.searchsorted(np.cumsum(bins), share * total)) for share in (0.5, 0.99))
    return (p50 + 1) * BIN_S, (p99 + 1) * BIN_S


def _await_buses(addresses: Iterable[str], *, flexible: bool) -> None:
    """Wait until an emulator, which starts at the same time, serves its buses.

    Raises:
        OpenArmError: ENVIRONMENT, when it does not within half a minute.
    """
    deadline = time.monotonic() + _EMULATOR_S
    for address in addresses:
        while True:
            try:
                open_bus(address, flexible=flexible).close()
                break
            except OpenArmError:
                if time.monotonic() > deadline:
                    raise
                time.sleep(0.1)


def _servo_model(config: HardwareNodeConfig, wiring: Wiring, robot: RobotDescription, load: ArmLoad) -> ServoModel:
    """Return the servos of an arm with the gains that the motors are given."""
    gains = {"stiffness": wiring.joints.stiffness, "damping": wiring.joints.damping}
    return config.servos.model_copy(update=gains).model(robot, load)


def make() -> OpenArmHardware:
    """Make the node for a process of its own."""
    return timely(OpenArmHardware, lambda node: node.config.thread_priority)


def main() -> None:
    """Run the node."""
    run(make)


if __name__ == "__main__":
    main()
