# SPDX-License-Identifier: Apache-2.0
"""Emulated motors behind local sockets, each with an inertia, a damping and a weight of its own.

For tests and measurements of the servo; arms that are coupled and touch things are those of the simulated robot. The
process `python -m openarm_hardware.emulator` is told what to do by lines of JSON on its standard input; answers follow.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from openarm_common.errors import OpenArmError
from openarm_common.motors.axis import Axis
from openarm_common.motors.emulated import EmulatedBuses, EmulatedMotor
from openarm_common.motors.frames import MitCommand
from openarm_common.motors.server import BusServer
from openarm_hardware.servo import schedule

#: Inertia (kg m2) and weight (N m, times the sine of the position) by largest torque of a motor.
_INERTIA, _WEIGHT = 0.005, 0.05
_VISCOUS = 0.02
#: Longest step of the physics, s, and longest time that is made up.
_STEP_S, _MOST_S = 0.002, 0.1
#: A command that goes back by this much is one that holds, rad.
_BACK = 0.002


class LooseJoints:
    """Each motor moves a joint of its own.

    Args:
        motors: The motors.
        weight: Share of the weights.
    """

    def __init__(self, motors: Sequence[EmulatedMotor], weight: float = 1.0) -> None:
        self._motors, self._weight = motors, weight
        self._t_ns = 0

    def advance(self, now_ns: int) -> None:
        """Move all joints until a time."""
        seconds = min((now_ns - self._t_ns) * 1e-9, _MOST_S) if self._t_ns else 0.0
        self._t_ns = now_ns
        steps = math.ceil(seconds / _STEP_S)
        for motor in self._motors:
            motor.expire(now_ns)
            for _ in range(steps):
                self._step(motor, seconds / steps)

    def _step(self, motor: EmulatedMotor, h: float) -> None:
        largest = motor.kind.tau_max
        inertia, weight = _INERTIA * largest, _WEIGHT * largest * self._weight
        bias, k, d, limit = motor.law()
        wanted = bias - k * motor.q
        held = wanted - weight * math.sin(motor.q)
        motor.dq = (motor.dq + h * held / inertia) / (1.0 + h * (d + _VISCOUS * largest + h * k) / inertia)
        motor.tau = min(max(wanted - d * motor.dq, -limit), limit)
        motor.q += h * motor.dq


class WatchedServer(BusServer):
    """Notes when joints are commanded to hold or to damp; arguments as `BusServer`."""

    def __init__(self, buses: EmulatedBuses, advance: Callable[[int], None], *, flexible: bool = True) -> None:
        super().__init__(buses, advance, flexible=flexible)
        #: Time at which each motor was first commanded to hold or to damp since it was last emptied.
        self.held = dict[str, int]()
        self._before = dict[str, float]()

    def _taken(self, now_ns: int) -> None:
        for motor in self.buses.motors:
            command, joint = motor.command, motor.axis.joint
            if isinstance(command, MitCommand):
                held = command.kp == 0.0 or command.q < self._before.get(joint, command.q) - _BACK
                self._before[joint] = command.q
                if held and joint not in self.held:
                    self.held[joint] = now_ns


def request(axes: Sequence[Axis], start: Mapping[str, float], **options: Any) -> str:
    """Return the line by which the process is told what it emulates.

    Args:
        axes: The motors.
        start: Positions of joints that do not start at 0.
        options: `weight`, `priority`, `seed`, `flexible`.
    """
    return json.dumps({"axes": [asdict(axis) for axis in axes], "start": dict(start), **options}) + "\n"


def _take(server: WatchedServer, line: str) -> dict[str, Any]:
    """Do what a line says; return the answer."""
    asked: dict[str, Any] = json.loads(line)
    if "fault" in asked:
        try:
            server.buses.inject(asked["fault"], asked.get("joint", ""), float(asked.get("value", 0.0)))
        except OpenArmError as error:
            return {"error": str(error)}
    if "forget" in asked:
        server.held.clear()
    found: dict[str, Any] = {"t_ns": time.monotonic_ns(), "held": server.held, "cpu_s": time.process_time()}
    for motor in server.buses.motors:
        axis = motor.axis
        row = {"q": (motor.q - axis.offset) / axis.ratio, "on": motor.on, "commands": motor.commands}
        found[axis.joint] = row | {"error": motor.error, "timeout": motor.registers[9], "mode": motor.registers[10]}
    return found


def main() -> int:
    """Run the process until its input ends."""
    asked = json.loads(sys.stdin.readline())
    axes = [Axis(**axis) for axis in asked["axes"]]
    motors = [EmulatedMotor(axis, asked["start"].get(axis.joint, 0.0) * axis.ratio + axis.offset) for axis in axes]
    buses = EmulatedBuses(motors, asked.get("seed", 0))
    joints = LooseJoints(motors, asked.get("weight", 1.0))
    server = WatchedServer(buses, joints.advance, flexible=asked.get("flexible", True))
    schedule(asked.get("priority", 0))
    os.write(1, b"{}\n")
    rest = b""
    while True:
        if server.serve(0.005, also=(0,)):
            data = os.read(0, 4096)
            if not data:
                server.close()
                return 0
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                os.write(1, json.dumps(_take(server, line.decode())).encode() + b"\n")


if __name__ == "__main__":
    sys.exit(main())
