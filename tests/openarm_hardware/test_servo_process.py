# SPDX-License-Identifier: Apache-2.0
"""The process of the servo before a process of emulated motors; no time is asserted, deadlines are guards."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from openarm_common.errors import Code
from openarm_common.motors.axis import Axis
from openarm_common.motors.wiring import load_wiring
from openarm_hardware.arm import Phase
from openarm_hardware.client import ServoProcess
from openarm_hardware.emulator import request
from openarm_hardware.exchange import State
from openarm_hardware.scan import scanned
from openarm_hardware.settings import Settings
from tests.openarm_hardware.bench import made_axes
from tests.refusals import refused

UP = (Phase.FOLLOWING, Phase.FOLLOWING)
#: The machine of the tests may be busy: what is asserted is what happens, not when.
PATIENT = Settings(
    priority=0, silent=1000, stale_s=10.0, ramp_s=0.05, timeout_s=2.0, orphan_s=0.5, release_s=0.3, period_s=0.01
)
GUARD_S = 60.0


class Rig:
    """Emulated motors, and servos before them."""

    def __init__(self, folder: Path, axes: tuple[Axis, ...] = (), **options: Any) -> None:
        self.axes = axes or made_axes((f"unix:{folder}/a", f"unix:{folder}/b"))
        self._emulator = subprocess.Popen(
            [sys.executable, "-m", "openarm_hardware.emulator"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            bufsize=0,
        )
        start = {axis.joint: 0.02 if axis.grips else 0.3 for axis in self.axes}
        self._write(request(self.axes, start, weight=0.0, **options))
        self._read()
        self.servos = list[ServoProcess]()

    def ask(self, **line: Any) -> dict[str, Any]:
        self._write(json.dumps(line) + "\n")
        return self._read()

    def servo(self, settings: Settings = PATIENT) -> ServoProcess:
        self.servos.append(ServoProcess(self.axes, settings))
        return self.servos[-1]

    def hold(self, servo: ServoProcess) -> State | None:
        """Command where the joints are, or what is commanded already."""
        state = servo.state()
        if state is not None:
            on = [phase in (Phase.RAMPING, Phase.FOLLOWING, Phase.HELD) for phase in state.phases]
            joints = [
                (m.command if on[i // 8] else m.q, 1.0 if axis.grips else 0.0)
                for i, (m, axis) in enumerate(zip(state.motors, self.axes, strict=True))
            ]
            servo.command(joints)
        return state

    def until(self, servo: ServoProcess, condition: Callable[[State], bool], *, client: bool = True) -> State:
        """Command the servo until a condition holds."""
        end, state = time.monotonic() + GUARD_S, None
        while time.monotonic() < end:
            state = self.hold(servo) if client else servo.state()
            if state is not None and condition(state):
                return state
            threading.Event().wait(0.005)
        raise AssertionError(f"not reached: {state}")

    def up(self) -> ServoProcess:
        servo = self.servo()
        self.until(servo, lambda state: state.phases == UP)
        return servo

    def close(self) -> None:
        for servo in self.servos:
            if servo.alive:
                os.kill(servo.pid, signal.SIGKILL)
            servo.close(5.0)
        self._emulator.stdin.close()
        self._emulator.wait(GUARD_S)

    def _write(self, line: str) -> None:
        self._emulator.stdin.write(line.encode())

    def _read(self) -> dict[str, Any]:
        return json.loads(self._emulator.stdout.readline())


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    found = Rig(tmp_path)
    yield found
    found.close()


def test_a_servo_has_one_thread_holds_says_what_stopped_it_and_ends_with_motors_that_are_off(rig: Rig) -> None:
    servo = rig.up()
    assert len(os.listdir(f"/proc/{servo.pid}/task")) == 1
    before = rig.ask()
    assert all(before[axis.joint]["on"] for axis in rig.axes)
    assert {before[axis.joint]["mode"] for axis in rig.axes} == {1, 4}
    servo.stop()
    state = rig.until(servo, lambda state: state.phases == (Phase.HELD, Phase.HELD))
    assert "emergency stop" in state.text
    servo.reset()
    rig.until(servo, lambda state: state.phases == UP)
    servo.stop("one_4 is commanded to touch two_4;\nno line of its own")
    state = rig.until(servo, lambda state: state.phases == (Phase.HELD, Phase.HELD))
    assert state.text == "one_4 is commanded to touch two_4; no line of its own"
    servo.reset()
    state = rig.until(servo, lambda state: state.phases == UP and sum(state.periods) > 20)
    after = rig.ask()
    for axis in rig.axes:
        assert after[axis.joint]["q"] == pytest.approx(0.02 if axis.grips else 0.3, abs=0.01)
    servo.close(GUARD_S)
    assert not any(rig.ask()[axis.joint]["on"] for axis in rig.axes)


def test_a_fault_of_a_motor_is_read_by_the_client(rig: Rig) -> None:
    servo = rig.up()
    rig.ask(fault="error", joint="two_4", value=0xC)
    state = rig.until(servo, lambda state: state.phases == (Phase.HELD, Phase.DAMPED))
    assert "two_4" in state.text
    assert "rotor too hot" in state.text
    assert state.motors[11].status == 0xC
    servo.reset()
    rig.until(servo, lambda state: state.phases == UP)


def test_a_client_that_dies_leaves_arms_that_are_held_and_then_released(rig: Rig) -> None:
    servo = rig.up()
    servo.abandon()
    state = rig.until(servo, lambda state: state.phases == (Phase.HELD, Phase.HELD), client=False)
    assert "the client has ended" in state.text
    rig.until(servo, lambda state: state.phases == (Phase.OFF, Phase.OFF), client=False)
    end = time.monotonic() + GUARD_S
    while servo.alive and time.monotonic() < end:
        threading.Event().wait(0.01)
    assert not servo.alive
    assert not any(rig.ask()[axis.joint]["on"] for axis in rig.axes)


@pytest.mark.long
def test_a_second_client_is_refused(rig: Rig) -> None:
    """After the time that the first may take to give the buses up."""
    rig.up()
    assert refused("in use by another process", rig.servo).code is Code.BUSY


def test_a_new_client_takes_over_arms_that_are_held_without_letting_them_go(rig: Rig) -> None:
    first = rig.up()
    first.abandon()
    second = rig.up()
    assert not first.alive
    found = rig.ask()
    assert all(found[axis.joint]["error"] == 0 for axis in rig.axes)
    assert second.alive


@pytest.mark.long
def test_motors_of_a_servo_that_dies_switch_themselves_off_and_a_new_one_says_so(rig: Rig) -> None:
    servo = rig.up()
    os.kill(servo.pid, signal.SIGKILL)
    end = time.monotonic() + GUARD_S
    while any(rig.ask()[axis.joint]["on"] for axis in rig.axes) and time.monotonic() < end:
        threading.Event().wait(0.02)
    found = rig.ask()
    assert {found[axis.joint]["error"] for axis in rig.axes} == {0xD}
    again = rig.servo()
    state = rig.until(again, lambda state: state.phases == (Phase.REFUSED, Phase.REFUSED))
    assert "lost communication" in state.text
    again.reset()
    rig.until(again, lambda state: state.phases == UP)
    os.kill(again.pid, signal.SIGTERM)
    rig.until(again, lambda state: state.phases == (Phase.OFF, Phase.OFF), client=False)


def test_a_bus_that_is_not_there_is_refused(tmp_path: Path) -> None:
    for bus, text in (
        (f"unix:{tmp_path}/none", "is the emulator running"),
        ("socketcan:none0", "none0"),
        ("can0", "expected socketcan:INTERFACE"),
    ):
        axes = made_axes((bus, bus))
        refused(text, ServoProcess, axes, PATIENT)


def test_a_scan_lists_the_motors_that_answer_and_switches_none_on(rig: Rig) -> None:
    wiring = load_wiring()
    rig.ask(fault="silent", joint="one_3")
    found = scanned(list(dict.fromkeys(axis.bus for axis in rig.axes)), wiring)
    assert len(found) == 15
    first, finger = found[0], found[6]
    assert (first.id, first.status, first.mode, first.timeout_s, first.ranges) == (
        1,
        "disabled",
        "MIT",
        0.0,
        (12.5, 45.0, 54.0),
    )
    assert first.q == pytest.approx(0.3, abs=0.001)
    assert (finger.id, finger.celsius, finger.firmware) == (8, 35, "5015")
    assert not any(rig.ask()[axis.joint]["on"] for axis in rig.axes)
