# SPDX-License-Identifier: Apache-2.0
"""All arms of a robot: commands reach them while they are fresh, and what stops one holds the others.

Pure: no clock, no bus, no process.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_hardware.arm import ArmMachine, Phase
from openarm_hardware.exchange import Command, MotorState
from openarm_hardware.settings import Settings

STOPPED = "the emergency stop is latched"


class Machine:
    """Commands all motors of a robot.

    Args:
        axes: All of them, in the order of the joints; those of an arm are on one bus.
        settings: Settings of commands and limits.
        last: Positions by joint when they were last seen.

    Attributes:
        arms: Arms by name.
        buses: Address of the bus of each arm, in the order of `arms`.
    """

    def __init__(self, axes: Sequence[Axis], settings: Settings, last: Mapping[str, float] | None = None) -> None:
        self._settings = settings
        names = list(dict.fromkeys(axis.arm for axis in axes))
        self._at = {name: [i for i, axis in enumerate(axes) if axis.arm == name] for name in names}
        self.arms = {name: ArmMachine([axes[i] for i in at], settings, last or {}) for name, at in self._at.items()}
        self.buses = [axes[at[0]].bus for at in self._at.values()]
        self._axes = axes
        self._command_ns = 0
        self._late = ""
        self._answer = ""

    def step(self, now_ns: int, received: Sequence[Sequence[Frame]], command: Command | None) -> list[list[Frame]]:
        """Return the frames of a cycle for the bus of each arm.

        Args:
            now_ns: Time, CLOCK_MONOTONIC.
            received: Frames from the bus of each arm since the last cycle.
            command: The newest one of the client.
        """
        fresh = self._fresh(now_ns, command)
        for arm, came in zip(self.arms.values(), received, strict=True):
            arm.receive(came, now_ns)
        out = list[list[Frame]]()
        for name, arm in self.arms.items():
            mine = [fresh.joints[i] for i in self._at[name]] if fresh is not None else None
            out.append(arm.step(now_ns, mine))
        self._spread(now_ns)
        return out

    def stop(self, now_ns: int, received: Sequence[Sequence[Frame]], why: str = STOPPED) -> list[list[Frame]]:
        """Hold all arms where they are, until `reset`; return the frames that do so, to be sent at once."""
        for arm, came in zip(self.arms.values(), received, strict=True):
            arm.receive(came, now_ns)
            arm.hold(why, now_ns)
        return [arm.frames() for arm in self.arms.values()]

    def reset(self, now_ns: int) -> None:
        """Let all arms go on whose cause of a stop is gone."""
        whys = [arm.reset(now_ns) for arm in self.arms.values()]
        self._answer = "; ".join(f"not reset: {why}" for why in whys if why)

    def hold(self, why: str, now_ns: int) -> None:
        """Hold all arms until `reset`."""
        for arm in self.arms.values():
            arm.hold(why, now_ns)

    def release(self, why: str, now_ns: int) -> None:
        """Let all arms sink and switch their motors off."""
        for arm in self.arms.values():
            arm.release(why, now_ns)

    @property
    def ended(self) -> bool:
        """Whether all motors are off for good."""
        return all(arm.phase is Phase.OFF for arm in self.arms.values())

    @property
    def text(self) -> str:
        """Why arms wait, hold or sink."""
        said = [f"{name}: {arm.text}" for name, arm in self.arms.items() if arm.text]
        if len(set(texts := [arm.text for arm in self.arms.values()])) == 1 and texts[0]:
            said = texts[:1]
        return "; ".join([*said, *filter(None, (self._answer, self._late))])

    def motors(self) -> tuple[MotorState, ...]:
        """Return the state of all motors, in the order of the joints."""
        found: list[MotorState | None] = [None] * len(self._axes)
        for name, arm in self.arms.items():
            for i, m in zip(self._at[name], arm.motors, strict=True):
                found[i] = MotorState(m.q, m.dq, m.tau, *m.command, m.status, m.mosfet, m.rotor, m.lost, m.turn)
        return tuple(state for state in found if state is not None)

    def _fresh(self, now_ns: int, command: Command | None) -> Command | None:
        """Return a command that is new and not old; without one the arms go to the last and hold."""
        if command is None:
            return None
        age_s = (now_ns - command.t_ns) * 1e-9
        self._late = f"no command for {age_s:.1f} s; holding" if age_s > self._settings.stale_s else ""
        if self._late or command.t_ns <= self._command_ns:
            return None
        self._command_ns = command.t_ns
        return command

    def _spread(self, now_ns: int) -> None:
        """Hold every arm when one of them was stopped: what they do together is over."""
        for name in [name for name, arm in self.arms.items() if arm.phase in (Phase.HELD, Phase.DAMPED)]:
            for other in self.arms.values():
                if other.phase is Phase.FOLLOWING:
                    other.hold(f"because {name} was stopped", now_ns)
