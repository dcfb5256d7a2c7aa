# SPDX-License-Identifier: Apache-2.0
"""One motor as the servo sees and commands it, in the units of its joint."""

from __future__ import annotations

import math
from collections.abc import Sequence

from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Frame
from openarm_common.motors.frames import ControlMode, Feedback, MitCommand, PosForceCommand, Register, Status
from openarm_hardware.settings import Settings

#: What an encoder may show beyond what the speed of a joint explains, of one reply to the next, rad.
_ENCODER_SLACK = 0.05
#: A motor whose position fits its joint's limits with several turns is the one that is within this of where the joint
#: was last seen, rad of the motor.
_NEAR = 0.5
#: What is typed to go on.
_RESET = "reset (`ros2 service call /openarm_hardware/reset std_srvs/srv/Trigger`)"
#: Torque that moves any joint against its friction, N m.
_STICTION = 3.0
_RANGES = {Register.PMAX: "rad", Register.VMAX: "rad/s", Register.TMAX: "N m"}


class MotorAxis:
    """State and commands of one motor.

    Args:
        axis: Its wiring.
        settings: Settings of its limits.

    Attributes:
        q, dq, tau: Of the joint, by the newest reply; NaN before one.
        status: Nibble of the newest reply; -1 before one.
        mosfet, rotor: Temperatures, °C.
        missed: Replies that were left out in a row.
        lost: And since the start.
        registers: Values that were read or confirmed.
        turn: Added to the motor's readings, rad: turns that it lost without power.
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
        self.turn = 0.0
        self.command = (math.nan, 0.0)
        #: Share of the gains; the motor was switched on when it was found.
        self.share = 0.0
        self.asked = False
        self._target = (math.nan, 0.0)
        self._slack = settings.slack / max(1.0, abs(axis.ratio))
        self._stuck = max(settings.stuck, _STICTION / axis.kp) if axis.kp > 0.0 else math.inf
        #: Where the joint was when its reading last changed or was missing, and its command then.
        self._anchor = (math.nan, math.nan)
        self._left_s = 0.0
        self._seen_ns = 0
        #: Newest position by the motor.
        self._read = math.nan
        #: It was switched on here, which replies of some ids do not tell.
        self._enabled = False
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
        state = frames.decode_feedback(self.kind, data, self.axis.id)
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
            return f"{self.axis} reports: {self.said}"
        return ""

    @property
    def said(self) -> str:
        """What its status says, in words."""
        return frames.status_text(self.status, self.axis.id)

    @property
    def warm(self) -> str:
        """Why it is too hot; else nothing."""
        hottest = max(self.mosfet, self.rotor)
        text = f"{self.axis} is at {hottest} °C, expected below {self._settings.hot} °C"
        return text if hottest >= self._settings.hot else ""

    def place(self, last: float | None) -> str:
        """Find the turn with which the joint is within its limits; return why that is not known, else nothing.

        A motor that gets power reads a position within half a turn of its zero, wherever it is.

        Args:
            last: Position at which the joint was last seen; None: nowhere.
        """
        axis, slack = self.axis, self._slack
        turns = {turn: (self._read + turn - axis.offset) / axis.ratio for turn in (0.0, math.tau, -math.tau)}
        fits = [turn for turn, q in turns.items() if axis.lower - slack <= q <= axis.upper + slack]
        if len(fits) > 1 and last is not None:
            fits = [turn for turn in fits if abs(turns[turn] - last) * abs(axis.ratio) <= _NEAR] or fits
        if len(fits) != 1:
            return self._nowhere([turns[turn] for turn in fits or turns], last)
        self.turn = fits[0]
        self.q = turns[self.turn]
        if (farthest := max(abs(self._motor_q(q)) for q in (axis.lower, axis.upper))) > self.kind.q_max:
            return (
                f"the motor of {axis} would be at up to {farthest:.2f} rad within the limits of its joint, beyond the"
                f" {self.kind.q_max:g} rad of its frames; {self._rezero}"
            )
        return ""

    def misplaced(self, last: float) -> str:
        """Return why the joint is elsewhere than where it was last seen; else nothing."""
        axis, most = self.axis, self._settings.posture
        if axis.grips or abs(self.q - last) <= most:
            return ""
        return (
            f"{axis} is at {self.q:.3f} {axis.unit} and was at {last:.3f} {axis.unit} when it was last seen, more than"
            f" {most:g} {axis.unit} away; was it moved by hand, or has its zero jumped? Look, then {_RESET}"
        )

    @property
    def _rezero(self) -> str:
        return f"bring the joint to 0 {self.axis.unit} and type `openarm hardware zero {self.axis.joint}`"

    def _nowhere(self, places: Sequence[float], last: float | None) -> str:
        """Return why the joint may be at none of some places, or at any, and what to do."""
        axis, unit, around = self.axis, self.axis.unit, math.tau / abs(self.axis.ratio)
        at = f"{axis} reads {self._read:.3f} rad: its joint is at {' or '.join(f'{q:.3f}' for q in places)} {unit}"
        limits = f"its limits {axis.lower:.3f} to {axis.upper:.3f} {unit}"
        if not axis.lower - self._slack <= places[0] <= axis.upper + self._slack:
            return f"{at}, all out of {limits}; bring it within them and {_RESET}, or, if it is: {self._rezero}"
        kept = "it was not seen before" if last is None else f"it was last seen at {last:.3f} {unit}"
        low, high = axis.upper + self._slack - around, axis.lower - self._slack + around
        by_hand = f"turn it by hand to between {low:.3f} and {high:.3f} {unit} and {_RESET}, or " * (low < high)
        return f"{at}, by turns of its motor all within {limits}, and {kept}; {by_hand}{self._rezero}"

    # --- registers
    def forget(self) -> None:
        """Read and set all registers again."""
        self.registers.clear()
        self.configured = False

    @property
    def scaled(self) -> str:
        """Why its frames mean something else than is assumed; else nothing."""
        for key, unit in _RANGES.items():
            found = self.registers.get(key)
            if found is not None and not abs(found - self._wanted[key]) <= 1e-3:  # it may be no number
                text = f"{self.axis} has register {Register(key).name} = {found:g}, a {self.kind.name} has"
                why = "its type in hardware.yaml is wrong, or the register was changed"
                return f"{text} {self._wanted[key]:g} {unit}; {why}"
        return ""

    @property
    def lacking(self) -> str:
        """The first register that has not the value it must have, in words; nothing when all have."""
        wrong = [key for key, value in self._wanted.items() if self.registers.get(key) != value]
        return (
            f"{Register(wrong[0]).name} = {self._wanted[wrong[0]]:g}, has {self.registers.get(wrong[0])}"
            if wrong
            else ""
        )

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
            return f"the command of {axis} is {q} {axis.unit}, {tau} N m, expected numbers"
        before = self._target[0]
        if not axis.grips and abs(q - before) > self._settings.jump:
            expected = f"expected steps below {self._settings.jump:g} {axis.unit}"
            return f"the command of {axis} jumps from {before:.3f} to {q:.3f} {axis.unit}, {expected}"
        self._target = (min(max(q, axis.lower - self._slack), axis.upper + self._slack), tau)
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
        return f"{self.axis} stays at {self.q:.4f} rad {way}; is its encoder dead, or the joint blocked?"

    @property
    def strays(self) -> str:
        """Why the joint does not follow its command; else nothing."""
        off = abs(self.q - self.command[0])
        if self.axis.grips or not off > self._settings.tracking:
            return ""
        most = self._settings.tracking
        return f"{self.axis} is {off:.3f} rad off its command, expected {most:g} rad at most; is it blocked?"

    def frame(self) -> Frame:
        """Return the frame that commands it."""
        axis, (q, tau) = self.axis, self.command
        motor_q = self._motor_q(q)
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

    def expect_off(self) -> None:
        """Take it for off until it was switched on here, where replies of its id do not tell."""
        self._enabled = False
        if frames.hides_enabled(self.axis.id) and self.status == Status.ENABLED:
            self.status = Status.DISABLED

    def enable_frame(self) -> Frame:
        """Return the frame that switches it on."""
        self._enabled = True
        return frames.enable(self.axis.id)

    def refresh_frame(self) -> Frame:
        """Return the frame that asks for a reply."""
        return self._refresh

    def _note(self, state: Feedback, now_ns: int) -> str:
        axis = self.axis
        before, seconds = self.q, (now_ns - self._seen_ns) * 1e-9
        self._read = state.q
        self.q = (state.q + self.turn - axis.offset) / axis.ratio
        self.dq, self.tau = state.dq / axis.ratio, state.tau * axis.ratio
        if self._enabled and state.status == Status.DISABLED and frames.hides_enabled(axis.id):
            state = state._replace(status=Status.ENABLED)
        self.status, self.mosfet, self.rotor = state.status, state.mosfet, state.rotor
        self.missed, self.asked, self._seen_ns = 0, False, now_ns
        allowed = axis.speed * max(seconds, self._settings.period_s) * 1.2 + _ENCODER_SLACK / max(1.0, abs(axis.ratio))
        if abs(self.q - before) > allowed:
            return f"{axis} jumped from {before:.3f} to {self.q:.3f} {axis.unit} in {seconds * 1e3:.0f} ms"
        return ""

    def _motor_q(self, q: float) -> float:
        """Return what the motor reads when the joint is at a position."""
        return q * self.axis.ratio + self.axis.offset - self.turn


def turn_text(axis: Axis, q: float, turn: float) -> str:
    """Return that a motor lost a turn, in words; nothing without one.

    Args:
        axis: The motor.
        q: Position of its joint.
        turn: See `MotorAxis`.
    """
    read = q * axis.ratio + axis.offset - turn
    limits = f"{axis.lower:.3f} to {axis.upper:.3f} {axis.unit}"
    taken = f"{turn:+.3f} rad (a turn) was added, by which its joint is at {q:.3f} {axis.unit}"
    return f"{axis} reads {read:.3f} rad; {taken}, within its limits {limits}" if turn else ""
