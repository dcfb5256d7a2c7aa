# SPDX-License-Identifier: Apache-2.0
"""Motors that lost turns without power, and arms of one bus: right, or refused with the reason, in simulated time."""

from __future__ import annotations

import math
import random
from collections.abc import Sequence
from dataclasses import replace

import pytest

from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_hardware.arm import UNPLACED, Phase
from openarm_hardware.axis import turn_text
from tests.openarm_hardware.bench import Bench, made_axes

pytestmark = pytest.mark.requirement("R-08")

UP = [Phase.FOLLOWING, Phase.FOLLOWING]
#: Limits of an OpenArm v1's first joint, and of one that turns by more than a turn.
SHOULDER, WIDE = (-3.490, 1.396), (-3.6, 3.6)
SLACK = 0.1


def axes_of_two_arms(*, one_bus: bool) -> tuple[Axis, ...]:
    """Shoulders as those of an OpenArm v1, and wrists with more than a turn."""
    limits = {0: SHOULDER, 6: WIDE}
    made = made_axes(("unix:a", "unix:a" if one_bus else "unix:b"))
    return tuple(
        replace(axis, lower=low, upper=high)
        for i, axis in enumerate(made)
        for low, high in [limits.get(i % 8, (axis.lower, axis.upper))]
    )


def fitting(axis: Axis, q: float) -> list[float]:
    """Places a turn of the motor apart that are within the limits of a joint."""
    around = 2.0 * math.pi / abs(axis.ratio)
    slack = SLACK / max(1.0, abs(axis.ratio))
    return [q + k * around for k in (-2, -1, 0, 1, 2) if axis.lower - slack <= q + k * around <= axis.upper + slack]


@pytest.mark.parametrize("seed", range(20))
def test_a_start_with_lost_turns_is_right_or_refused_with_the_reason(seed: int) -> None:
    rng = random.Random(seed)
    axes = axes_of_two_arms(one_bus=bool(seed % 2))
    start = [rng.uniform(axis.lower, axis.upper) for axis in axes]
    known = {axis.joint: q for axis, q in zip(axes, start, strict=True)} if seed % 3 else {}
    bench = Bench(axes, start=start, last=known, ramp_s=0.02)
    bench.buses.inject("power")
    bench.buses.inject("clear")
    for axis in axes:
        if rng.random() < 0.3:  # a motor that was turned without power
            reads = bench.motors[axes.index(axis)].q + bench.motors[axes.index(axis)].zero
            bench.buses.inject("turn", axis.joint, -math.copysign(1.0, reads))
    unsure = [axis.joint for axis, q in zip(axes, start, strict=True) if len(fitting(axis, q)) > 1 and not known]
    for _ in range(400):
        bench.tick()
        for arm, phase in zip(("one", "two"), bench.phases, strict=True):
            mine = [motor for motor in bench.motors if motor.axis.arm == arm]
            if phase in UNPLACED:
                assert not any(motor.on or motor.commands for motor in mine), "it was commanded before it was placed"
    for i, arm in enumerate(("one", "two")):
        if joints := [joint for joint in unsure if joint.startswith(arm)]:
            assert bench.phases[i] is Phase.REFUSED
            assert any(joint in bench.machine.text for joint in joints)
            assert "it was not seen before; turn it by hand to between" in bench.machine.text
            assert "openarm hardware zero" in bench.machine.text
        else:
            assert bench.phases[i] is Phase.FOLLOWING, bench.machine.text
            rows = zip(axes, start, bench.machine.motors(), bench.q(), strict=True)
            for axis, was, said, now in [row for row in rows if row[0].arm == arm]:
                assert said.q == pytest.approx(was, abs=2e-3), axis
                assert now == pytest.approx(was, abs=2e-3), axis


def placed(axis: Axis, reads: float, last: float | None = None) -> Bench:
    """A bench whose first motor reads a position, rad."""
    rest = made_axes()[1:]
    start = [0.02 if a.grips else 0.3 for a in rest]
    known = {} if last is None else {axis.joint: last}
    bench = Bench((axis, *rest), start=[(reads - axis.offset) / axis.ratio, *start], last=known, ramp_s=0.02)
    bench.run(0.4)
    return bench


def shoulder(limits: Sequence[float] = SHOULDER) -> Axis:
    return replace(made_axes()[0], lower=limits[0], upper=limits[1])


@pytest.mark.parametrize(
    ("reads", "last", "expected"),
    [
        (2.983, None, -3.300),  # a shoulder at -3.300 rad
        (-3.300, None, -3.300),  # the same, which had power all the time
        (0.5, None, 0.5),
        (1.45, None, 1.45),  # a little beyond its limit, as is allowed at the start
        (2.983, -3.2, -3.300),
    ],
)
def test_the_turn_within_the_limits_is_taken(reads: float, last: float | None, expected: float) -> None:
    bench = placed(shoulder(), reads, last)
    assert bench.phases == UP, bench.machine.text
    state = bench.machine.motors()[0]
    assert state.q == pytest.approx(expected, abs=1e-3)
    said = turn_text(bench.axes[0], state.q, state.turn)
    if reads > 2.0:
        assert f"one_1 (motor 0x01 of unix:a) reads {reads:.3f} rad; -6.283 rad (a turn) was added" in said
        assert f"its joint is at {expected:.3f} rad, within its limits -3.490 to 1.396 rad" in said
    else:
        assert said == ""
    number, data = bench.sent[0][0]
    command = frames.decode_mit(frames.motor_type("DM8009"), data)
    assert number == 1
    assert command is not None
    assert command.q == pytest.approx(reads, abs=1e-3)  # in the motor's own frame


def test_a_gripper_that_lost_a_turn_is_taken_where_it_is() -> None:
    bench = Bench(start=[(6.227 / -23.8) if a.joint == "one_finger" else 0.02 if a.grips else 0.3 for a in made_axes()])
    bench.run(3.0)
    bench.until(UP, 6.0)
    state = bench.machine.motors()[7]
    assert state.q == pytest.approx((6.227 - 2.0 * math.pi) / -23.8, abs=1e-4)
    assert "is at 0.002 m, within its limits 0.000 to 0.044 m" in turn_text(bench.axes[7], state.q, state.turn)
    assert bench.motors[7].q == pytest.approx(6.227, abs=0.02)


def test_commands_and_limits_are_those_of_the_joint_after_a_turn() -> None:
    bench = placed(shoulder(), 2.983)
    start, since = [s.command for s in bench.machine.motors()], bench.now_ns

    def lower() -> list[tuple[float, float]]:
        down = min(0.38, 0.4 * (bench.now_ns - since) * 1e-9)
        return [(q - down * (i == 0), float(a.grips)) for i, (q, a) in enumerate(zip(start, bench.axes, strict=True))]

    bench.client = lower
    bench.run(2.0)
    assert bench.phases == UP, bench.machine.text
    assert bench.machine.motors()[0].command == pytest.approx(-3.490 - SLACK, abs=1e-6)
    assert bench.machine.motors()[0].q == pytest.approx(-3.590, abs=0.01)
    assert bench.motors[0].q == pytest.approx(2.983 - 0.29, abs=0.01)


def test_gains_rise_slowly_in_an_arm_with_a_motor_that_lost_a_turn() -> None:
    bench = placed(shoulder(), 2.983)
    quick = Bench(ramp_s=0.3)
    slow = Bench(bench.axes, start=[2.983, *(0.02 if a.grips else 0.3 for a in bench.axes[1:])], ramp_s=0.3)
    cycles = [b.until([Phase.FOLLOWING, Phase.FOLLOWING], 8.0) for b in (quick, slow)]
    assert cycles[1] > 5 * cycles[0]


@pytest.mark.parametrize(
    ("limits", "reads", "last", "texts"),
    [
        (
            (-2.0, 2.0),
            3.0,
            None,
            ["its joint is at 3.000 or 9.283 or -3.283 rad", "out of its limits -2.000 to 2.000 rad"],
        ),
        (
            WIDE,
            3.0,
            None,
            ["is at 3.000 or -3.283 rad", "it was not seen before", "between -2.583 and 2.583 rad and reset"],
        ),
        (WIDE, 3.0, 0.5, ["is at 3.000 or -3.283 rad", "it was last seen at 0.500 rad"]),
        ((-9.0, 4.0), 3.0, None, ["is at 3.000 or -3.283 rad", "openarm hardware zero one_1"]),
        ((-0.1, 9.5), -3.0, None, []),
    ],
)
def test_what_is_not_known_is_refused_with_all_places_and_what_to_do(
    limits: tuple[float, float], reads: float, last: float | None, texts: list[str]
) -> None:
    bench = placed(shoulder(limits), reads, last)
    if not texts:
        assert bench.machine.motors()[0].q == pytest.approx(reads + 2.0 * math.pi, abs=1e-3)
        return
    assert bench.phases[0] is Phase.REFUSED
    for text in ("one_1 (motor 0x01 of unix:a) reads 3.000 rad", *texts):
        assert text in bench.machine.text
    assert not bench.motors[0].on
    bench.machine.reset(bench.now_ns)
    bench.run(0.3)
    assert bench.phases[0] is Phase.REFUSED, "a reset alone does not make it known"


def test_a_kept_posture_tells_which_of_two_turns_it_is() -> None:
    for last, expected in ((2.8, 3.0), (-3.2, 3.0 - 2.0 * math.pi)):
        bench = placed(shoulder(WIDE), 3.0, last)
        assert bench.phases == UP, bench.machine.text
        assert bench.machine.motors()[0].q == pytest.approx(expected, abs=1e-3)


def test_limits_that_the_frames_of_a_motor_can_not_say_are_refused() -> None:
    bench = placed(shoulder((8.0, 13.0)), 8.5 - 2.0 * math.pi)
    assert bench.phases[0] is Phase.FOLLOWING
    bench = placed(shoulder((8.0, 13.0)), 8.5)
    assert bench.phases[0] is Phase.REFUSED
    assert "would be at up to 13.00 rad" in bench.machine.text
    assert "beyond the 12.5 rad of its frames" in bench.machine.text


def test_a_motor_that_lost_its_power_and_a_turn_is_placed_again_at_the_reset() -> None:
    bench = placed(shoulder(), -3.300)
    before = bench.q()
    bench.buses.inject("power")
    bench.run(0.2)
    bench.buses.inject("clear")
    bench.run(0.1)
    bench.machine.reset(bench.now_ns)
    bench.run(1.5)
    assert bench.phases == UP, bench.machine.text
    assert bench.machine.motors()[0].turn == pytest.approx(-2.0 * math.pi)
    assert bench.q() == pytest.approx(before, abs=0.05)


@pytest.mark.parametrize("off_s", [0.0, 0.2])
def test_power_that_goes_and_comes_before_the_start_is_noticed(off_s: float) -> None:
    bench = Bench((shoulder(), *made_axes()[1:]), start=[-3.300, *(0.02 if a.grips else 0.3 for a in made_axes()[1:])])
    bench.client = None
    bench.run(0.4)
    assert bench.phases == [Phase.SETTING, Phase.SETTING]
    bench.buses.inject("power")
    bench.run(off_s)
    bench.buses.inject("clear")
    bench.client = bench.here
    bench.run(7.0)
    assert bench.phases == UP, bench.machine.text
    assert bench.machine.motors()[0].q == pytest.approx(-3.300, abs=1e-3)
    assert all(motor.registers[9] == 4000 for motor in bench.motors[: 16 if off_s else 8])


def test_sixteen_motors_of_one_bus_come_up_and_go_off_as_on_two() -> None:
    axes = made_axes(("unix:a", "unix:a"))
    assert axes[15].reply_id == 0x20
    bench = Bench(axes, weight=1.0, ramp_s=0.1).up(carried=True)
    bench.move(0.3)
    bench.run(0.5)
    assert bench.phases == UP, bench.machine.text
    bench.buses.inject("error", "two_finger", 0xC)
    bench.until([Phase.HELD, Phase.DAMPED], 0.1)
    assert "two_finger (motor 0x10 of unix:a) reports: rotor too hot or lost communication" in bench.machine.text
    bench.repair(1.0)
    assert bench.phases == UP, bench.machine.text
    bench.machine.release("end", bench.now_ns)
    bench.run(7.0)
    assert not any(motor.on for motor in bench.motors)
