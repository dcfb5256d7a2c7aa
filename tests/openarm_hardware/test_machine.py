# SPDX-License-Identifier: Apache-2.0
"""What is sent to the motors, in simulated time: how they come up, what stops them, how they go on."""

from __future__ import annotations

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.motors import frames
from openarm_common.motors.bus import Frame
from openarm_hardware.arm import Phase
from openarm_hardware.axis import MotorAxis
from openarm_hardware.exchange import Command
from openarm_hardware.settings import Settings
from tests.openarm_hardware.bench import PERIOD_NS, Bench, made_axes

pytestmark = pytest.mark.requirement("R-08")

UP = [Phase.FOLLOWING, Phase.FOLLOWING]
HALF = [Phase.DAMPED, Phase.HELD]


def test_without_a_client_nothing_is_switched_on_and_nothing_is_commanded() -> None:
    bench = Bench()
    bench.client = None
    bench.run(1.0)
    assert bench.phases == [Phase.SETTING, Phase.SETTING]
    assert "waiting for a client" in bench.machine.text
    assert not any(motor.on or motor.commands for motor in bench.motors)
    assert all(motor.registers[9] == 4000 for motor in bench.motors)
    assert {motor.registers[10] for motor in bench.motors if motor.axis.grips} == {4}


@settings(max_examples=3, deadline=None)
@given(st.floats(-1.9, 1.9), st.floats(0.0, 1.0))
def test_arms_come_up_where_they_are(start: float, weight: float) -> None:
    """Whatever the posture, they move by no more than they sink before they are carried."""
    bench = Bench(start=start, weight=weight, ramp_s=0.2)
    # an arm without power rests on something: here its joints are held until their motors are on
    bench.client = bench.carried
    before = [motor.q for motor in bench.motors]
    while bench.phases != UP:
        bench.tick()
        if not all(motor.on for motor in bench.motors):
            for motor, q in zip(bench.motors, before, strict=True):
                motor.q, motor.dq = q, 0.0
        assert bench.now_ns < 5e9, bench.machine.text
        if bench.phases[0] is Phase.ENABLING:
            assert set(bench.kp(0)) <= {0.0}
    bench.run(0.3)
    moved = max(abs(m.q - q) for m, q in zip(bench.motors, before, strict=True) if not m.axis.grips)
    assert moved < (0.02 if weight < 0.01 else 0.6 * weight)
    assert max(abs(motor.dq) for motor in bench.motors if not motor.axis.grips) < 0.4


@pytest.fixture
def bench() -> Bench:
    """Both arms are up."""
    return Bench().up()


def test_commands_are_joined_by_lines_and_followed(bench: Bench) -> None:
    start, since = bench.q(), bench.now_ns

    def wave() -> list[tuple[float, float]]:
        off = 0.2 * (1.0 - math.cos(2.0 * (bench.now_ns - since) * 1e-9))
        return [(0.01, 1.5) if a.grips else (q + off, 0.0) for q, a in zip(start, bench.axes, strict=True)]

    bench.client = wave
    steps, before = [], None
    for _ in range(400):
        bench.tick()
        now = bench.machine.motors()[0].command
        steps.append(abs(now - before) if before is not None else 0.0)
        before = now
    assert bench.phases == UP, bench.machine.text
    assert max(steps) < 0.4 * 0.004 * 1.3  # of 0.4 rad/s at most: no stairs
    wanted = wave()
    for q, (target, _), axis in zip(bench.q(), wanted, bench.axes, strict=True):
        assert q == pytest.approx(target, abs=0.002 if axis.grips else 0.03)


def test_a_silent_motor_stops_its_arm_softly_and_the_other_one_holds() -> None:
    bench = Bench(weight=1.0, silent=3).up(carried=True)
    held = bench.q()[8:15]
    bench.buses.inject("silent", "one_3")
    assert bench.until(HALF, 0.1) <= 4  # 3 replies left out and the one that was under way
    assert "one_3 (motor 0x03 of unix:a) has left out 3 replies" in bench.machine.text
    assert bench.kp(0) == [0.0] * 7
    assert min(bench.kp(1)) > 9.9
    bench.run(0.5)
    assert bench.q()[8:15] == pytest.approx(held, abs=0.02)
    assert max(abs(motor.dq) for motor in bench.motors[:7]) < 2.0  # it sinks, and does not fall
    bench.machine.reset(bench.now_ns)
    bench.run(1.5)
    assert bench.phases[0] is Phase.LOOKING
    assert "no reply of one_3" in bench.machine.text
    bench.buses.inject("clear")
    bench.up()


FAULTS = [
    ("error", "one_2", 0xB, HALF, "mosfet too hot"),
    ("error", "one_finger", 0xE, HALF, "overload"),
    ("zero", "one_1", 1.0, HALF, "jumped from"),
    ("bus_off", "one_1", 0.0, HALF, "has left out"),
    ("power", "", 0.0, [Phase.DAMPED, Phase.DAMPED], "has left out"),
    ("hot", "one_5", 95.0, [Phase.HELD, Phase.HELD], "at 95 °C"),
]


@pytest.mark.parametrize(("fault", "joint", "value", "phases", "text"), FAULTS)
def test_a_fault_is_named_latched_and_reset_when_it_is_gone(bench: Bench, fault, joint, value, phases, text) -> None:
    bench.buses.inject(fault, joint, value)
    assert bench.until(phases, 0.2) <= 6
    assert text in bench.machine.text
    bench.run(0.5)
    assert bench.phases == phases
    if phases[0] is Phase.HELD:
        bench.machine.reset(bench.now_ns)
        bench.run(0.1)
        assert bench.phases[0] is Phase.HELD
        assert "not reset" in bench.machine.text
    bench.buses.inject("clear")
    if fault == "power":  # arms without power have to be looked at
        for motor in bench.motors:
            assert motor.registers[9] == 0
    bench.run(0.1)
    bench.machine.reset(bench.now_ns)
    bench.up()
    assert all(motor.registers[9] == 4000 for motor in bench.motors)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, 0.8, -0.8])
def test_a_command_that_jumps_is_not_followed(bench: Bench, wrong: float) -> None:
    before = bench.q()
    good = bench.client
    assert good is not None
    bench.client = lambda: [(q + wrong if i == 4 else q, tau) for i, (q, tau) in enumerate(good())]
    bench.until([Phase.HELD, Phase.HELD], 0.1)
    assert "one_5" in bench.machine.text
    bench.run(0.5)
    assert bench.q() == pytest.approx(before, abs=0.005)
    bench.client = good
    bench.machine.reset(bench.now_ns)
    bench.run(0.1)
    assert bench.phases == UP


def test_commands_beyond_the_limits_end_at_them() -> None:
    bench = Bench(start=1.9).up()
    since = bench.now_ns
    bench.client = lambda: [
        (0.02, 1.0) if a.grips else (1.9 + 0.5 * (bench.now_ns - since) * 1e-9, 0.0) for a in bench.axes
    ]
    bench.run(1.0)
    assert max(q for q, a in zip(bench.q(), bench.axes, strict=True) if not a.grips) < 2.25


def test_a_frozen_encoder_is_found_when_the_arm_moves(bench: Bench) -> None:
    bench.buses.inject("freeze", "one_4")
    bench.move(0.5)
    bench.until([Phase.DAMPED, Phase.HELD], 0.3)
    assert "one_4" in bench.machine.text
    assert "is its encoder dead" in bench.machine.text


def test_motors_that_are_not_heard_of_for_a_while_are_not_taken_for_dead_encoders() -> None:
    bench = Bench(silent=100, tracking=2.0).up()
    bench.move(1.0)
    for _ in range(4):
        bench.run(0.1)
        kept = list[list[Frame]]([[], []])
        for _ in range(60):  # an emulator that halts, and then answers all frames at once
            sent = bench.machine.step(bench.now_ns, [[], []], bench.command)
            if bench.commands % 3 == 0:
                bench.command = Command(bench.now_ns, tuple(bench.client()))
            bench.commands += 1
            for mine, new, bus in zip(kept, sent, bench.machine.buses, strict=True):
                mine.extend(bench.buses.take(bus, new, bench.now_ns))
            bench.now_ns += PERIOD_NS
        bench.waiting = kept
        bench.joints.advance(0)  # it does not make up for the time
        bench.joints.advance(bench.now_ns)
    bench.run(0.05)
    assert bench.phases == UP, bench.machine.text


def test_a_joint_that_is_blocked_is_found_by_its_distance_from_the_command() -> None:
    bench = Bench(weight=0.0).up()
    bench.move(0.5)
    blocked, command = bench.motors[3], bench.client
    stop = blocked.q

    def push() -> list[tuple[float, float]]:
        blocked.q, blocked.dq = stop + 1e-3 * math.sin(0.1 * bench.commands), 0.0  # the encoder lives
        return command()

    bench.client = push
    bench.until([Phase.HELD, Phase.HELD], 1.5)
    assert "one_4" in bench.machine.text
    assert "off its command" in bench.machine.text


def test_without_fresh_commands_the_arms_hold_and_go_on_with_the_next(bench: Bench) -> None:
    good, bench.client = bench.client, None
    before = bench.q()
    bench.run(2.0)
    assert bench.phases == UP
    assert "no command for" in bench.machine.text
    assert bench.q() == pytest.approx(before, abs=0.002)
    bench.client = good
    bench.run(0.1)
    assert bench.machine.text == ""


def test_a_command_that_is_old_when_it_comes_is_not_followed(bench: Bench) -> None:
    away = tuple((q if axis.grips else q + 0.3, t) for (q, t), axis in zip(bench.here(), bench.axes, strict=True))
    before, bench.client = bench.q(), None
    bench.run(1.0)
    for _ in range(100):
        bench.command = Command(bench.now_ns - int(2e9 * bench.settings.stale_s), away)
        bench.tick()
    assert bench.phases == UP, bench.machine.text
    assert bench.q() == pytest.approx(before, abs=0.002)


def test_a_reply_of_a_register_that_comes_late_is_no_position(bench: Bench) -> None:
    late = [
        (axis.reply_id, frames.register_reply(axis.id, *register, written=False))
        for axis, motor in zip(bench.axes[:8], bench.motors[:8], strict=True)
        for register in motor.registers.items()
    ]
    bench.waiting = [[*mine, *late] for mine in bench.waiting]
    before = bench.machine.motors()
    bench.tick()
    assert bench.phases == UP, bench.machine.text
    assert [s.q for s in bench.machine.motors()] == pytest.approx([s.q for s in before], abs=0.01)


def test_a_gear_divides_the_speed_and_multiplies_the_torque() -> None:
    axis = MotorAxis(made_axes()[7], Settings())
    axis.take(frames.encode_feedback(axis.kind, frames.Feedback(1, 8, -0.5, 2.0, 0.4, 30, 40)), 1)
    assert axis.dq == pytest.approx(2.0 / -23.8, rel=0.01)
    assert axis.tau == pytest.approx(0.4 * -23.8, rel=0.02)


@pytest.mark.requirement("B-55")
def test_the_emergency_stop_holds_at_once_with_the_weight_carried() -> None:
    bench = Bench(weight=1.0).up(carried=True)
    bench.move(0.5)
    bench.run(0.5)
    torque = [s.command_tau for s in bench.machine.motors()]
    stopped = bench.q()
    bench.exchange(bench.machine.stop(bench.now_ns, bench.waiting))
    assert [len(sent) for sent in bench.sent] == [8, 8]
    assert bench.phases == [Phase.HELD, Phase.HELD]
    assert [s.command_tau for s in bench.machine.motors()] == torque
    bench.run(1.0)
    moved = [abs(a - b) for a, b, axis in zip(bench.q(), stopped, bench.axes, strict=True) if not axis.grips]
    assert max(moved) < 0.05  # it rings, and comes back
    assert max(abs(motor.dq) for motor in bench.motors[:7]) < 0.02
    bench.machine.reset(bench.now_ns)
    assert bench.phases == UP


def test_a_zero_that_jumped_is_refused_by_name_until_somebody_has_looked() -> None:
    bench = Bench(last={"one_2": 1.2, "two_2": 0.3})
    bench.run(0.3)
    assert bench.phases[0] is Phase.REFUSED
    assert "one_2" in bench.machine.text
    assert "was at 1.200" in bench.machine.text
    assert not any(motor.on for motor in bench.motors[:8])
    bench.machine.reset(bench.now_ns)
    bench.up()


def test_what_is_wrong_at_the_start_is_refused() -> None:
    bench = Bench(start=2.5)
    bench.run(0.3)
    assert bench.phases == [Phase.REFUSED, Phase.REFUSED]
    assert "out of its limits -2.000 to 2.000" in bench.machine.text
    bench = Bench()
    bench.motors[2].registers[22] = 8.0
    bench.run(0.3)
    assert bench.phases[0] is Phase.REFUSED
    assert "one_3 (motor 0x03 of unix:a) has register VMAX = 8, a DM4340 has 10" in bench.machine.text
    bench = Bench()
    bench.motors[1].fail(0x9)
    bench.run(0.3)
    assert bench.phases[0] is Phase.REFUSED
    assert "under voltage" in bench.machine.text
    bench.machine.reset(bench.now_ns)
    bench.up()


def test_registers_that_are_no_numbers_or_are_not_taken_end_in_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.motors[2].registers[21] = math.nan
    bench.run(1.0)
    assert bench.phases[0] is Phase.REFUSED
    assert "one_3 (motor 0x03 of unix:a) has register PMAX = nan, a DM4340 has 12.5 rad" in bench.machine.text
    old = Bench()
    take = old.exchange

    def exchange(sent: list[list[Frame]]) -> None:
        """Let a motor of another firmware answer a write of its mode with the one that it has."""
        write, read = frames.write_register(8, 10, 4), frames.read_register(8, 10)
        take([[read if frame == write else frame for frame in mine] for mine in sent])

    monkeypatch.setattr(old, "exchange", exchange)
    old.run(0.5)
    assert "setting mode and timeout of one_finger (motor 0x08 of unix:a)" in old.machine.text
    assert "firmware" not in old.machine.text
    old.run(1.5)
    assert "one_finger (motor 0x08 of unix:a) does not take CTRL_MODE = 4, has " in old.machine.text
    assert "; `openarm hardware scan` names its firmware" in old.machine.text


def test_lost_and_late_replies_are_no_false_alarm() -> None:
    bench = Bench(silent=5)
    bench.buses.inject("loss", value=0.05)
    bench.up()
    bench.run(4.0)
    assert bench.phases == UP
    assert sum(state.lost for state in bench.machine.motors()) > 100


def test_the_end_lets_arms_sink_and_switches_them_off() -> None:
    bench = Bench(weight=1.0).up(carried=True)
    bench.machine.release("the client has ended", bench.now_ns)
    fastest = 0.0
    while not bench.machine.ended:
        bench.tick()
        fastest = max(fastest, *(abs(motor.dq) for motor in bench.motors[:7]))
    bench.run(0.1)
    assert fastest < 2.0
    assert not any(motor.on for motor in bench.motors)


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2**32))
def test_frames_that_are_none_of_the_motors_change_nothing(seed: int) -> None:
    rng = random.Random(seed)

    def junk() -> list[list[tuple[int, bytes]]]:
        found = []
        for _ in range(2):
            ids = [rng.randrange(0x800) for _ in range(3)]
            wrong = [(i if not 17 <= i <= 24 else 0x7FF, rng.randbytes(rng.randrange(65))) for i in ids]
            found.append([*wrong, (rng.randrange(17, 25), rng.randbytes(rng.choice((0, 3, 7, 12, 64))))])
        return found

    clean, noisy = Bench(), Bench()
    noisy.noise = junk
    for _ in range(220):
        clean.tick()
        noisy.tick()
        assert noisy.sent == clean.sent


@settings(max_examples=3, deadline=None)
@given(st.integers(0, 2**32))
def test_no_bytes_from_the_bus_make_a_command(seed: int) -> None:
    """Replies of any content: without a client nothing but questions and settings goes out, and nothing raises."""
    rng = random.Random(seed)
    bench = Bench()
    bench.client = None
    bench.noise = lambda: [[(rng.randrange(16, 26), rng.randbytes(8)) for _ in range(8)] for _ in range(2)]
    for _ in range(100):
        bench.tick()
        assert {number for sent in bench.sent for number, _ in sent} <= {frames.REGISTER_ID}
    bench.client = bench.here
    bench.run(0.5)


#: Each kind of fault once, then drawn at random.
TRIALS = pytest.mark.parametrize("trials", [10, pytest.param(200, marks=pytest.mark.long)])


@TRIALS
def test_an_arm_never_moves_by_itself_whatever_happens_to_it(trials: int) -> None:
    """Faults while it is still, most of them reset: joints without weight stay where they are."""
    rng = random.Random(5)
    bench = Bench(silent=3, ramp_s=0.02).up()
    kinds = ["silent", "error", "hot", "freeze", "loss", "bus_off", "power", "stop", "client", "zero"]
    for trial in range(trials):
        before = bench.q()
        kind = kinds[trial] if trial < len(kinds) else rng.choice(kinds)
        joint = rng.choice(bench.axes).joint
        error, zero = rng.choice((8, 9, 10, 11, 12, 13, 14)), rng.uniform(-0.3, 0.3)
        values = {"error": error, "hot": 99, "loss": 0.3, "zero": zero}
        if kind == "stop":
            bench.exchange(bench.machine.stop(bench.now_ns, bench.waiting))
        elif kind == "client":
            bench.client = None
        elif kind != "zero" or rng.random() < 0.2:
            bench.buses.inject(kind, joint, values.get(kind, 0.0))
        bench.run(rng.uniform(0.01, 0.1))
        bench.repair(0.2)
        assert bench.phases == UP, (trial, kind, joint, bench.machine.text)
        for axis, was, now in zip(bench.axes, before, bench.q(), strict=True):
            assert abs(now - was) < (0.004 if axis.grips else 0.03), (trial, kind, axis.joint, was, now)
    assert bench.now_ns > PERIOD_NS


@TRIALS
def test_an_arm_that_is_stopped_in_motion_stays_whatever_is_commanded_until_it_is_reset(trials: int) -> None:
    """Faults while all joints move; the client goes on commanding, as if it had heard of nothing."""
    rng = random.Random(11)
    bench = Bench(silent=3, ramp_s=0.02).up()
    kinds = ["silent", "error", "hot", "freeze", "bus_off", "power", "stop", "zero", "jump"]
    for trial in range(trials):
        kind, since = kinds[trial] if trial < len(kinds) else rng.choice(kinds), bench.now_ns
        # a soft joint may stay where friction holds it
        joint = rng.choice([a.joint for a in bench.axes if a.kp > (30.0 if kind == "freeze" else 0.0)])
        start = [s.command for s in bench.machine.motors()]
        speeds = [0.0 if a.grips else rng.choice((-1.0, 1.0)) * rng.uniform(0.3, 0.6) for a in bench.axes]
        speeds = [-abs(v) if q > 0.8 else abs(v) if q < -0.8 else v for v, q in zip(speeds, start, strict=True)]
        leap = [0.0]

        def moving(since=since, start=start, speeds=speeds, leap=leap, joint=joint) -> list[tuple[float, float]]:
            t = (bench.now_ns - since) * 1e-9
            rows = zip(start, speeds, bench.axes, strict=True)
            return [(q + v * t + (leap[0] if a.joint == joint else 0.0), float(a.grips)) for q, v, a in rows]

        bench.client = moving
        bench.run(rng.uniform(0.05, 0.4))
        if kind == "stop":
            bench.exchange(bench.machine.stop(bench.now_ns, bench.waiting))
        elif kind == "jump":
            leap[0] = 0.5
        else:
            value = {"error": rng.choice((8, 9, 10, 11, 12, 13, 14)), "hot": 99, "zero": rng.choice((-0.3, 0.3))}
            bench.buses.inject(kind, joint, value.get(kind, 0.0))
        bench.run(0.8)
        assert not {Phase.FOLLOWING, Phase.RAMPING} & {*bench.phases}, (trial, kind, joint)
        assert bench.machine.text, (trial, kind)
        stopped = bench.q()
        bench.run(0.3)
        for axis, was, now in zip(bench.axes, stopped, bench.q(), strict=True):
            # without power a joint runs out against its friction
            assert abs(now - was) < (0.05 if kind == "power" else 0.005), (trial, kind, axis.joint, was, now)
        bench.repair(0.25)
        assert bench.phases == UP, (trial, kind, joint, bench.machine.text)
        for axis, was, now in zip(bench.axes, stopped, bench.q(), strict=True):
            assert abs(now - was) < (0.004 if axis.grips else 0.05), (trial, kind, axis.joint, was, now)
