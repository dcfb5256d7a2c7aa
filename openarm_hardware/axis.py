# SPDX-License-Identifier: Apache-2.0
"""One motor as the servo sees and commands it, in the units of its joint."""

from __future__ import annotations

import math

from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_common.motors.frames import ControlMode, Feedback, MitCommand, PosForceCommand, Register, Status
from openarm_hardware.settings import Settings

#: What an encoder may show beyond what the speed of a joint explains, of one reply to the next, rad.
_ENCODER_SLACK = 0.05
#: Torque that moves any joint against its friction, N m.
_STICTION = 3.0
_RANGES = (Register.PMAX, Register.VMAX, Register.TMAX)


class MotorAxis:
    """State and commands of one motor.

    Args:
        axis: Its wiring.
        settings: How it is watched.

    Attributes:
        q, dq, tau: Of the joint, by the newest reply; NaN before one.
        status: Nibble of the newest reply; -1 before one.
        mosfet, rotor: Temperatures, °C.
        missed: Replies that were left out in a row.
        lost: And since the start.
        registers: Values that were read or confirmed.
        command: Position, torque (of grippers the largest one) of the joint that is commanded now.
    """

    def __init__(self, axis: Axis, settings: Settings) -> None:
        self.axis, self._settings = axis, settings
        self.kind = frames.motor_type(axis.type)
        self.q = self.dq = self.tau = math.nan
        self.status = -1
        self.mosfet = self.rotor = 0
        self.missed = self.lost = 0
        self.registers = dict[int, float]()
        self.command = (math.nan, 0.0)
        #: Share of the gains; the motor was switched on when it was found.
        self.share = 0.0
        self.asked = False
        self._target = (math.nan, 0.0)
        self._stuck = max(settings.stuck, _STICTION / axis.kp) if axis.kp > 0.0 else math.inf
        #: Where the joint was when its reading last changed or was missing, and its command then.
        self._anchor = (math.nan, math.nan)
        self._left_s = 0.0
        self._seen_ns = 0
        damping = MitCommand(0.0, 0.0, 0.0, axis.damping, 0.0)
        mode = ControlMode.POS_FORCE if axis.grips else ControlMode.MIT
        timeout = round(settings.timeout_s / frames.TIMEOUT_STEP_S)
        ranges = zip(_RANGES, (self.kind.q_max, self.kind.dq_max, self.kind.tau_max), strict=True)
        #: Values that registers must have: ranges, by which frames are scaled, then mode and timeout.
        self._wanted: dict[int, float] = {**dict(ranges), Register.CTRL_MODE: mode, Register.TIMEOUT: timeout}
        #: Whether all of them have.
        self.configured = False
        self._damping = (axis.id, frames.encode_mit(self.kind, damping))
        self._refresh = frames.refresh(axis.id)

    # --- replies
    def take(self, data: bytes, now_ns: int) -> str:
        """Take a frame with the reply id; return why its state can't be trusted, else nothing."""
        reply = frames.decode_register(data)
        if reply is not None and reply.id == self.axis.id:  # in any phase: a reply may be late
            if reply.register in self._wanted:
                self.registers[reply.register] = reply.value
                self.configured = self._wanted.items() <= {k: round(v, 3) for k, v in self.registers.items()}.items()
            self.asked = False
            return ""
        state = frames.decode_feedback(self.kind, data)
        if state is None or state.id != self.axis.id & 15:
            return ""
        return self._note(state, now_ns)

    def account(self) -> None:
        """Count the reply that a frame should have had by now."""
        if self.asked or self.q != self._anchor[0]:  # without a reply nothing is known of its position
            self._anchor = (self.q, self.command[0])
        if self.asked:
            self.missed += 1
            self.lost += 1
        self.asked = False

    @property
    def seen(self) -> bool:
        """Whether its newest replies have come."""
        return self.status >= 0 and self.missed == 0

    @property
    def broken(self) -> bool:
        """Whether it reports an error."""
        return self.status not in (Status.ENABLED, Status.DISABLED, -1)

    @property
    def gone(self) -> bool:
        """Whether too many replies are missing."""
        return self.missed >= self._settings.silent

    @property
    def fault(self) -> str:
        """Why its state says that it can't be commanded; of a motor that should be on."""
        if self.gone:
            return f"{self.axis} has left out {self.missed} replies"
        if self.status not in (Status.ENABLED, -1):
            return f"{self.axis} reports: {frames.status_text(self.status)}"
        return ""

    @property
    def warm(self) -> str:
        """Why it is too hot; else nothing."""
        hottest = max(self.mosfet, self.rotor)
        return f"{self.axis} is at {hottest} °C, expected below {self._settings.hot}" * (hottest >= self._settings.hot)

    def misplaced(self, last: float | None) -> str:
        """Return why its position is none to begin with.

        Args:
            last: Where the joint was last seen; None: nowhere.
        """
        axis, settings = self.axis, self._settings
        slack = settings.slack / max(1.0, abs(axis.ratio))
        if not axis.lower - slack <= self.q <= axis.upper + slack:
            return (
                f"{axis} is at {self.q:.3f}, out of its limits {axis.lower:.3f} to {axis.upper:.3f}; is its zero right?"
            )
        if last is not None and not axis.grips and abs(self.q - last) > settings.posture:
            return (
                f"{axis} is at {self.q:.3f} and was at {last:.3f} when it was last seen, more than"
                f" {settings.posture:g} away; was it moved by hand, or has its zero jumped? Look, then reset"
            )
        return ""

    # --- registers
    def forget(self) -> None:
        """Read and set all registers again."""
        self.registers.clear()
        self.configured = False

    @property
    def scaled(self) -> str:
        """Why its frames mean something else than is assumed; else nothing."""
        for key in _RANGES:
            found = self.registers.get(key)
            if found is not None and abs(found - self._wanted[key]) > 1e-3:
                text = f"{self.axis} has register {Register(key).name} = {found:g}, a {self.kind.name} has"
                return f"{text} {self._wanted[key]:g}; its type in hardware.yaml is wrong, or the register was changed"
        return ""

    def configure(self, *, write: bool) -> Frame:
        """Return the next frame that reads ranges or, with `write`, sets mode and timeout; else one that asks."""
        for key, value in self._wanted.items():
            if key in _RANGES and key not in self.registers:
                return frames.read_register(self.axis.id, key)
            if write and key not in _RANGES and self.registers.get(key) != value:
                return frames.write_register(self.axis.id, key, value)
        return self._refresh

    # --- commands
    def hold(self) -> None:
        """Command where the joint is; grippers keep what they hold."""
        if not self.axis.grips or math.isnan(self.command[0]):
            self.command = (self.q, self.command[1])
        self._target, self._left_s = self.command, 0.0
        self._anchor = (math.nan, math.nan)

    def aim(self, q: float, tau: float) -> str:
        """Go to a position with a torque until the next command comes; return why not, else nothing."""
        axis = self.axis
        if not (math.isfinite(q) and math.isfinite(tau)):
            return f"the command of {axis} is {q}, {tau}, expected numbers"
        before = self._target[0]
        if not axis.grips and abs(q - before) > self._settings.jump:
            expected = f"expected steps below {self._settings.jump:g}"
            return f"the command of {axis} jumps from {before:.3f} to {q:.3f}, {expected}"
        slack = self._settings.slack / max(1.0, abs(axis.ratio))
        self._target = (min(max(q, axis.lower - slack), axis.upper + slack), tau)
        self._left_s = self._settings.command_period_s
        return ""

    def near(self, q: float) -> bool:
        """Whether a position is one to begin with."""
        return self.axis.grips or abs(q - self.q) <= self._settings.jump

    def advance(self, seconds: float) -> None:
        """Move the command on its line to the target."""
        part = 1.0 if self._left_s <= seconds else seconds / self._left_s
        q, tau = self.command
        self.command = (q + part * (self._target[0] - q), tau + part * (self._target[1] - tau))
        self._left_s = max(0.0, self._left_s - seconds)

    def dead(self) -> str:
        """Return why its position can't be true, by what was commanded since it changed last; else nothing."""
        if self.axis.grips or not abs(self.command[0] - self._anchor[1]) > self._stuck:
            return ""
        way = f"while its command went {self._stuck:.2g} rad"
        return f"{self.axis} stays at {self.q:.4f} {way}; is its encoder dead, or the joint blocked?"

    @property
    def strays(self) -> str:
        """Why the joint does not follow its command; else nothing."""
        off = abs(self.q - self.command[0])
        if self.axis.grips or not off > self._settings.tracking:
            return ""
        most = self._settings.tracking
        return f"{self.axis} is {off:.3f} rad off its command, expected {most:g} at most; is it blocked?"

    def frame(self) -> Frame:
        """Return the frame that commands it."""
        axis, (q, tau) = self.axis, self.command
        motor_q = q * axis.ratio + axis.offset
        if axis.grips:
            current = min(abs(tau / axis.ratio), axis.torque) / self.kind.tau_max
            return frames.pos_force(axis.id, PosForceCommand(motor_q, axis.speed * abs(axis.ratio), current))
        command = MitCommand(motor_q, 0.0, self.share * axis.kp, axis.kd, self.share * tau / axis.ratio)
        return axis.id, frames.encode_mit(self.kind, command)

    def damping_frame(self) -> Frame:
        """Return the frame, made beforehand, that lets it move against damping alone; a gripper keeps its hold."""
        if not self.axis.grips:
            return self._damping
        return self.frame() if math.isfinite(self.command[0]) and self.status == Status.ENABLED else self._refresh

    def refresh_frame(self) -> Frame:
        """Return the frame that asks for a reply."""
        return self._refresh

    def _note(self, state: Feedback, now_ns: int) -> str:
        axis = self.axis
        before, seconds = self.q, (now_ns - self._seen_ns) * 1e-9
        self.q, self.dq, self.tau = (state.q - axis.offset) / axis.ratio, state.dq / axis.ratio, state.tau * axis.ratio
        self.status, self.mosfet, self.rotor = state.status, state.mosfet, state.rotor
        self.missed, self.asked, self._seen_ns = 0, False, now_ns
        allowed = axis.speed * max(seconds, self._settings.period_s) * 1.2 + _ENCODER_SLACK / max(1.0, abs(axis.ratio))
        if abs(self.q - before) > allowed:
            return f"{axis} jumped from {before:.3f} to {self.q:.3f} in {seconds * 1e3:.0f} ms"
        return ""
