# SPDX-License-Identifier: Apache-2.0
"""The motors of the simulated robot behind the frames of their buses, as `openarm_hardware` commands a real one.

A command is a law of the motor's torque, which MuJoCo evaluates in each physics step; gains of the profile don't count.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from openarm_common.motors.emulated import EmulatedBuses, EmulatedMotor
from openarm_common.motors.server import BusServer
from openarm_common.motors.wiring import axes_of, load_wiring
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_control.controller import JointController
from openarm_control.joints import JointReadout
from openarm_sim_bridge.world.world import World


class EmulatedRobot(JointController):
    """Motors of all joints of a world, on local sockets; takes part in each physics step.

    Args:
        description: The robot.
        world: World whose actuators they are.
        addresses: Addresses of the bus of each arm.
        clock: Clock of the motors' timeouts, ns.

    Attributes:
        buses: The motors, with their faults.
    """

    def __init__(
        self,
        description: RobotDescription,
        world: World,
        addresses: Mapping[str, str],
        clock: Callable[[], int] = time.monotonic_ns,
    ) -> None:
        self._clock = clock
        wiring = load_wiring()
        axes = {axis.joint: axis for axis in axes_of(wiring, description, addresses)}
        self.joint_names, self._world = world.joint_names, world
        self._motors = [EmulatedMotor(axes[name]) for name in self.joint_names]
        self._ratio = np.array([motor.axis.ratio for motor in self._motors])
        self._offset = np.array([motor.axis.offset for motor in self._motors])
        self._limits: Array = np.zeros(len(self._motors))
        self.buses = EmulatedBuses(self._motors)
        self._read(world.true_joints())
        self._server = BusServer(self.buses, lambda _: None, flexible=wiring.flexible)

    def update(self, state: JointReadout, dt_ns: int) -> Array:
        """See `JointController.update`; the targets do not count."""
        self._read(self._world.true_joints())
        self._server.serve(0.0)
        now_ns = self._clock()
        for motor in self._motors:
            motor.expire(now_ns)
        bias, stiffness, damping, limits = np.array([motor.law() for motor in self._motors]).T
        r = self._ratio
        self._world.set_laws(r * (bias - stiffness * self._offset), r * r * stiffness, r * r * damping)
        self._limits = np.abs(r) * limits
        return state.position

    def effort_limits(self) -> Array:
        """See `JointController.effort_limits`: of what the motors were commanded last."""
        return self._limits

    def reset(self, state: JointReadout) -> None:
        """See `JointController.reset`: motors stay as they are, their joints are elsewhere."""

    def stop(self, why: str) -> None:
        """See `JointController.stop`: it is for who commands the motors."""

    def abort(self, why: str) -> None:
        """See `JointController.abort`: there are no goals."""

    def close(self) -> None:
        """Close the sockets."""
        self._server.close()

    def _read(self, state: JointReadout) -> None:
        q = (state.position * self._ratio + self._offset).tolist()
        dq, tau = (state.velocity * self._ratio).tolist(), (state.effort / self._ratio).tolist()
        for i, motor in enumerate(self._motors):
            motor.q, motor.dq, motor.tau = q[i], dq[i], tau[i]
