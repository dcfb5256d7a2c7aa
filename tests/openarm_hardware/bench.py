# SPDX-License-Identifier: Apache-2.0
"""Motors and their servo in simulated time: no process, no clock."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_common.motors.emulated import EmulatedBuses, EmulatedMotor
from openarm_hardware.arm import Phase
from openarm_hardware.emulator import LooseJoints
from openarm_hardware.exchange import Command
from openarm_hardware.machine import Machine
from openarm_hardware.settings import Settings

PERIOD_NS = 4_000_000
TYPES = ("DM8009", "DM8009", "DM4340", "DM4340", "DM4310", "DM4310", "DM4310")
GAINS = (70.0, 70.0, 70.0, 60.0, 10.0, 10.0, 10.0)


def made_axes(buses: Sequence[str] = ("unix:a", "unix:b")) -> tuple[Axis, ...]:
    """Two arms of seven joints and a finger each; on one bus the second has the ids 9 to 16."""
    found = []
    for arm, bus in zip(("one", "two"), buses, strict=True):
        first = 8 if arm == "two" and bus == buses[0] else 0
        for i, (kind, kp) in enumerate(zip(TYPES, GAINS, strict=True)):
            turn = -1.0 if i == 3 else 1.0
            limits = (-2.0, 2.0, 16.0, kp, 2.0 if kp > 10.0 else 0.6, 5.0 if kp > 10.0 else 1.5, 10.0)
            found.append(
                Axis(
                    f"{arm}_{i + 1}", arm, bus, first + i + 1, first + i + 17, kind, turn, 0.1 * i, *limits, grips=False
                )
            )
        grip = (0.0, 0.044, 0.2, 0.0, 0.0, 0.0, 1.5)
        found.append(
            Axis(f"{arm}_finger", arm, bus, first + 8, first + 24, "DM4310", -23.8, 0.0, *grip, grips=True, unit="m")
        )
    return tuple(found)


class Bench:
    """A machine before emulated motors."""

    def __init__(
        self,
        axes: Sequence[Axis] = (),
        *,
        start: float | Sequence[float] = 0.3,
        weight: float = 0.0,
        last: dict[str, float] | None = None,
        **settings,
    ):
        self.axes = axes or made_axes()
        self.settings = Settings(**settings)
        at = [0.02 if a.grips else start for a in self.axes] if isinstance(start, float) else start
        self.motors = [EmulatedMotor(a, q * a.ratio + a.offset) for a, q in zip(self.axes, at, strict=True)]
        self.buses = EmulatedBuses(self.motors, seed=1)
        self.joints, self.weight = LooseJoints(self.motors, weight), weight
        self.machine = Machine(self.axes, self.settings, last)
        self.now_ns = 1_000_000_000
        self.waiting: list[list[Frame]] = [[], []]
        self.sent: list[list[Frame]] = [[], []]
        self.noise: Callable[[], list[list[Frame]]] = lambda: [[], []]
        #: What the client commands; None: it is silent.
        self.client: Callable[[], list[tuple[float, float]]] | None = self.here
        self.commands = 0
        self.command: Command | None = None

    @property
    def phases(self) -> list[Phase]:
        return [arm.phase for arm in self.machine.arms.values()]

    def q(self) -> list[float]:
        """True positions of the joints."""
        return [(m.q - m.axis.offset) / m.axis.ratio for m in self.motors]

    def weights(self) -> list[float]:
        """Torques of the joints that carry the emulator's weights."""
        return [
            self.weight * a.ratio * 0.05 * m.kind.tau_max * math.sin(m.q)
            for a, m in zip(self.axes, self.motors, strict=True)
        ]

    def carried(self) -> list[tuple[float, float]]:
        """As `here`, with the torques that carry the weights."""
        return [
            (q, 1.0 if axis.grips else weight)
            for (q, _), weight, axis in zip(self.here(), self.weights(), self.axes, strict=True)
        ]

    def here(self) -> list[tuple[float, float]]:
        """Command what is commanded already, before that where the joints are; torques of no weight."""
        states = self.machine.motors()
        on = [arm.phase in (Phase.RAMPING, Phase.FOLLOWING, Phase.HELD) for arm in self.machine.arms.values()]
        return [
            (s.command if on[i // 8] else s.q, 1.0 if axis.grips else 0.0)
            for i, (s, axis) in enumerate(zip(states, self.axes, strict=True))
        ]

    def tick(self) -> None:
        """One cycle; the client commands in every third."""
        if self.commands % 3 == 0 and self.client is not None and self.machine.motors()[0].status >= 0:
            self.command = Command(self.now_ns, tuple(self.client()))
        self.commands += 1
        received = [[*mine, *more] for mine, more in zip(self.waiting, self.noise(), strict=True)]
        self.exchange(self.machine.step(self.now_ns, received, self.command))
        self.now_ns += PERIOD_NS
        self.joints.advance(self.now_ns)

    def exchange(self, sent: list[list[Frame]]) -> None:
        self.sent = sent
        came = {bus: list[Frame]() for bus in self.machine.buses}
        for bus, mine in zip(self.machine.buses, sent, strict=True):
            came[bus] += self.buses.take(bus, mine, self.now_ns)
        self.waiting = [came[bus] for bus in self.machine.buses]

    def move(self, speed: float) -> None:
        """Let the client move all joints at a speed, with their weights carried; the fingers stay."""
        since, start = self.now_ns, [s.command for s in self.machine.motors()]
        self.client = lambda: [
            (q, 1.0) if a.grips else (q + speed * (self.now_ns - since) * 1e-9, weight)
            for q, weight, a in zip(start, self.weights(), self.axes, strict=True)
        ]

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 1e9 / PERIOD_NS)):
            self.tick()

    def until(self, phases: list[Phase], seconds: float) -> int:
        """Run until the arms are in phases; return the cycles that it took."""
        for cycle in range(round(seconds * 1e9 / PERIOD_NS)):
            if self.phases == phases:
                return cycle
            self.tick()
        raise AssertionError(f"{self.phases}, expected {phases}: {self.machine.text}")

    def up(self, *, carried: bool = False) -> Bench:
        """Bring both arms up; their client may carry the weights."""
        if carried:
            self.client = self.carried
        self.until([Phase.FOLLOWING, Phase.FOLLOWING], 3.0)
        return self

    def repair(self, seconds: float) -> None:
        """End all faults, reset the machine, and give the arms time to come up."""
        self.buses.inject("clear")
        for motor in self.motors:
            motor.zero = 0.0
        self.client = self.here
        self.run(0.02)
        self.machine.reset(self.now_ns)
        self.run(seconds)

    def kp(self, arm: int) -> list[float]:
        """Gains of the last commands to the joints of an arm."""
        kinds = [frames.motor_type(name) for name in TYPES]
        found = []
        for number, data in self.sent[arm]:
            if 1 <= number <= 7 and not frames.special(data):
                command = frames.decode_mit(kinds[number - 1], data)
                assert command is not None
                found.append(command.kp)
        return found
