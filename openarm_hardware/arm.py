# SPDX-License-Identifier: Apache-2.0
"""The motors of one arm, from the first look at them to the end: what is sent in each cycle, and why.

Pure: time and replies come as arguments, frames go out as results. Nothing is switched on before all motors have
answered, their ranges, errors, limits and last known places were checked, and a client commands where the arm is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from enum import IntEnum

from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_common.motors.frames import Status
from openarm_hardware.axis import MotorAxis
from openarm_hardware.settings import Settings

#: Gains of an arm that rests, with a motor that lost a turn, rise so many times slower.
_CAREFUL = 10.0
#: A motor that is not on after so long does not switch on, s.
_ENABLE_S = 1.0
#: The frame is repeated after so many cycles.
_AGAIN = 10
#: So many motors are named in a sentence.
_NAMED = 3
#: Joints that are slower than this rest, rad/s.
_RESTS = 0.05
#: Motors that have left out so many replies in a row are not waited for.
_GONE = 250


class Phase(IntEnum):
    """What an arm is doing."""

    LOOKING = 0  # asks the motors; nothing is switched on
    REFUSED = 1  # the same, and something must be put right first
    SETTING = 2  # sets mode and timeout, waits for the first command
    ENABLING = 3  # switches on, without gains
    RAMPING = 4  # raises the gains where the arm is
    FOLLOWING = 5  # follows commands
    HELD = 6  # holds where it was stopped, until reset
    DAMPED = 7  # sinks against damping, until reset
    RELEASING = 8  # the same, before it is switched off
    OFF = 9


#: In these, it is not known how many turns its motors have lost: their positions may be wrong.
UNPLACED = frozenset({Phase.LOOKING, Phase.REFUSED})
#: In these, motors are on and commanded.
ON = frozenset({Phase.ENABLING, Phase.RAMPING, Phase.FOLLOWING, Phase.HELD, Phase.DAMPED})


class ArmMachine:
    """Commands the motors of one arm.

    Args:
        axes: Its motors.
        settings: Settings of commands and limits.
        last: Positions by joint when they were last seen.

    Attributes:
        phase: Phase of the arm.
        text: Why it waits, holds or sinks.
    """

    def __init__(self, axes: Sequence[Axis], settings: Settings, last: Mapping[str, float]) -> None:
        self.motors = [MotorAxis(axis, settings) for axis in axes]
        self.phase, self.text = Phase.LOOKING, ""
        self._settings, self._last = settings, dict(last)
        self._by_reply = {motor.axis.reply_id: motor for motor in self.motors}
        self._cycles = 0
        self._since_ns = 0
        #: Its motors are on and damped while it looks: it was reset.
        self._sinks = False
        #: A reset was asked for: errors of motors may be cleared, and where the arm is was looked at.
        self._clears = False
        #: Time in which its gains rise.
        self._ramp_s = settings.ramp_s
        #: Its motors were switched on here.
        self._was_on = False

    # --- a cycle
    def receive(self, received: Sequence[Frame], now_ns: int) -> None:
        """Take what has come from the bus; frames that are none of its motors' are left out."""
        for number, data in received:
            motor = self._by_reply.get(number)
            if motor is None:
                continue
            why = motor.take(data, now_ns)
            if why and self.phase in ON:
                self.fail(why, now_ns)
            elif why and self.phase is Phase.SETTING:  # its power was off, or its zero was set: is all as it was found?
                for one in self.motors:
                    one.forget()
                self._become(Phase.LOOKING, why, now_ns)
        for motor in self.motors:
            motor.account()

    def step(self, now_ns: int, command: Sequence[tuple[float, float]] | None) -> list[Frame]:
        """Return the frames of a cycle.

        Args:
            now_ns: Time.
            command: Position and torque of each joint when there is a new command, else None.
        """
        self._cycles += 1
        if self.phase in ON:
            self._watch(now_ns)
        if self.phase in (Phase.LOOKING, Phase.REFUSED):
            self._look(now_ns)
        elif self.phase is Phase.SETTING:
            self._set(now_ns, command)
        elif self.phase is Phase.ENABLING:
            self._enable(now_ns)
        elif self.phase is Phase.RAMPING:
            self._ramp(now_ns)
        elif self.phase is Phase.FOLLOWING:
            self._follow(now_ns, command)
        elif self.phase is Phase.RELEASING:
            self._release(now_ns)
        out = self.frames()
        for motor in self.motors:
            motor.asked = True
        return out

    def frames(self) -> list[Frame]:
        """Return the frames of the present phase."""
        phase, again = self.phase, self._cycles % _AGAIN == 0
        if phase in (Phase.DAMPED, Phase.RELEASING):
            return [motor.damping_frame() for motor in self.motors]
        if phase in (Phase.RAMPING, Phase.FOLLOWING, Phase.HELD):
            return [motor.frame() for motor in self.motors]
        if phase is Phase.ENABLING:
            on = [motor.status == Status.ENABLED for motor in self.motors]
            off = MotorAxis.enable_frame if again else MotorAxis.refresh_frame
            return [motor.frame() if is_on else off(motor) for motor, is_on in zip(self.motors, on, strict=True)]
        if phase is Phase.OFF:
            return [frames.disable(motor.axis.id) for motor in self.motors] if again and self._was_on else []
        return [self._question(motor, again=again) for motor in self.motors]

    # --- what others ask
    def fail(self, why: str, now_ns: int) -> None:
        """Let the arm sink softly, because its state can't be trusted or a motor does not follow its command."""
        if self.phase in (Phase.ENABLING, Phase.RAMPING, Phase.FOLLOWING, Phase.HELD):
            self._become(Phase.DAMPED, why, now_ns)

    def hold(self, why: str, now_ns: int) -> None:
        """Hold where the arm is, with the torque that carries it, until reset; before it is on, refuse to begin."""
        if self.phase in (Phase.RAMPING, Phase.FOLLOWING):
            for motor in self.motors:
                motor.hold()
            self._become(Phase.HELD, why, now_ns)
        elif self.phase is Phase.ENABLING:
            self._become(Phase.DAMPED, why, now_ns)
        elif self.phase in (Phase.LOOKING, Phase.SETTING):
            self._become(Phase.REFUSED, why, now_ns)

    def reset(self, now_ns: int) -> str:
        """Go on after a stop, when its cause is gone; return why not, else nothing."""
        if self.phase is Phase.HELD:
            if why := next((m.fault or m.warm for m in self.motors if m.fault or m.warm), ""):
                return why
            self._become(Phase.FOLLOWING, "", now_ns)
        elif self.phase in (Phase.DAMPED, Phase.REFUSED):
            self._sinks = self._sinks or self.phase is Phase.DAMPED
            self._clears = True
            for motor in self.motors:
                motor.forget()
                motor.share = 0.0
            self._become(Phase.LOOKING, "", now_ns)
        return ""

    def release(self, why: str, now_ns: int) -> None:
        """Let the arm sink, then switch its motors off."""
        if self.phase in ON or self._sinks:
            self._become(Phase.RELEASING, why, now_ns)
        elif self.phase is not Phase.RELEASING:
            self._become(Phase.OFF, why, now_ns)

    # --- phases
    def _watch(self, now_ns: int) -> None:
        """Look for what stops an arm that is on."""
        if self.phase is Phase.DAMPED:
            return
        for motor in self.motors:
            if self.phase is Phase.ENABLING and motor.status == Status.DISABLED and not motor.gone:
                continue
            why = motor.fault or (motor.dead() if self.phase in (Phase.RAMPING, Phase.FOLLOWING) else "")
            if why:
                self.fail(why, now_ns)
                return
        for motor in self.motors:
            if self.phase in (Phase.RAMPING, Phase.FOLLOWING) and (why := motor.warm or motor.strays):
                self.hold(why, now_ns)
                return

    def _look(self, now_ns: int) -> None:
        if self.phase is Phase.REFUSED:
            return
        if silent := [motor for motor in self.motors if not motor.seen]:
            self._since_ns = now_ns
            self.text = (
                f"no reply of {_named(silent)}; is the arm's power on, its bus up? `openarm hardware scan` says more"
            )
            return
        if unread := [motor for motor in self.motors if len(motor.registers) < 3]:
            errors = [motor.fault for motor in unread if motor.broken]
            self.text = (
                errors[0] if errors else f"asking {_named(unread)}{self._patience('does not answer it', now_ns)}"
            )
            return
        for motor in self.motors:
            last = self._last.get(motor.axis.joint)
            why = motor.scaled or (motor.fault if motor.broken else "") or motor.place(last)
            why = why or (motor.misplaced(last) if last is not None and not self._clears else "")
            if why:
                self._become(Phase.REFUSED, why, now_ns)
                return
        self._become(Phase.SETTING, "", now_ns)

    def _set(self, now_ns: int, command: Sequence[tuple[float, float]] | None) -> None:
        if silent := [motor for motor in self.motors if motor.gone]:
            for motor in silent:
                motor.forget()
            self._become(Phase.LOOKING, f"no reply of {_named(silent)}", now_ns)
        elif unset := [motor for motor in self.motors if not motor.configured]:
            late = self._patience(f"{unset[0].axis} does not take {unset[0].lacking}", now_ns)
            self.text = f"setting mode and timeout of {_named(unset)}{late}"
        elif command is None:
            self.text = "waiting for a client"
        elif far := [m for m, (q, _) in zip(self.motors, command, strict=True) if not m.near(q)]:
            self.text = f"the client commands {far[0].axis} elsewhere than it is"
        else:
            for motor, (_, tau) in zip(self.motors, command, strict=True):
                motor.expect_off()
                motor.share = 1.0 if motor.status == Status.ENABLED and not self._sinks else 0.0
                motor.hold()
                motor.command = (motor.command[0], tau)
                motor.hold()
            careful = any(motor.turn for motor in self.motors) and not self._sinks
            self._ramp_s = self._settings.ramp_s * (_CAREFUL if careful else 1.0)
            self._sinks = False
            self._was_on = True
            self._become(Phase.ENABLING, "", now_ns)

    def _enable(self, now_ns: int) -> None:
        for motor in self.motors:
            if motor.share == 0.0:
                motor.hold()
        off = [motor for motor in self.motors if motor.status != Status.ENABLED]
        if not off:
            self._become(Phase.RAMPING, "", now_ns)
        elif now_ns - self._since_ns > _ENABLE_S * 1e9:
            self.fail(f"{off[0].axis} does not switch on: {off[0].said}", now_ns)

    def _ramp(self, now_ns: int) -> None:
        for motor in self.motors:
            motor.share = min(1.0, motor.share + self._settings.period_s / self._ramp_s)
        if all(motor.share >= 1.0 for motor in self.motors):
            self._become(Phase.FOLLOWING, "", now_ns)

    def _follow(self, now_ns: int, command: Sequence[tuple[float, float]] | None) -> None:
        if command is not None:
            for motor, (q, tau) in zip(self.motors, command, strict=True):
                if why := motor.aim(q, tau):
                    self.hold(why, now_ns)
                    return
        for motor in self.motors:
            motor.advance(self._settings.period_s)

    def _release(self, now_ns: int) -> None:
        passed = (now_ns - self._since_ns) * 1e-9
        rests = all(abs(motor.dq) < _RESTS or motor.missed > _GONE for motor in self.motors if not motor.axis.grips)
        if passed > self._settings.release_s or (rests and passed > 0.5):
            self._become(Phase.OFF, self.text, now_ns)

    def _question(self, motor: MotorAxis, *, again: bool) -> Frame:
        """Of an arm that looks: read and set registers; when it was reset, clear errors, and damp what sinks."""
        if self._clears and motor.broken:
            return frames.clear_error(motor.axis.id) if again else motor.refresh_frame()
        asks = motor.configure(write=self.phase is Phase.SETTING)
        damps = self._sinks and not (self._cycles % 2 and asks != motor.refresh_frame())
        return motor.damping_frame() if damps else asks

    def _patience(self, what: str, now_ns: int) -> str:
        """Return what goes on for too long, and what to do; nothing before."""
        way = "`openarm hardware scan` names its firmware, whose registers may be others"
        return f": {what}; {way}" if now_ns - self._since_ns > _ENABLE_S * 1e9 else ""

    def _become(self, phase: Phase, why: str, now_ns: int) -> None:
        self.phase, self.text, self._since_ns = phase, why, now_ns


def _named(motors: Sequence[MotorAxis]) -> str:
    names = [str(motor.axis) for motor in motors[:_NAMED]]
    return ", ".join(names) + (f" and {len(motors) - _NAMED} more" if len(motors) > _NAMED else "")
