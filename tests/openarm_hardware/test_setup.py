# SPDX-License-Identifier: Apache-2.0
"""Motors that are not set up, ids of arms on one bus, and both kinds of frames, before a process of emulated motors."""

from __future__ import annotations

import errno
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from openarm_bringup.commands import hardware as commands
from openarm_bringup.doctor.hardware import check_motors
from openarm_common.errors import Code
from openarm_common.motors.bus import Bus, Frame
from openarm_common.motors.frames import Register, read_register, register_reply
from openarm_common.motors.wiring import ArmWiring, Wiring, axes_of, load_wiring
from openarm_common.robot.description import RobotDescription
from openarm_hardware import scan, upkeep
from openarm_hardware.arm import Phase
from openarm_hardware.client import check_load
from openarm_hardware.scan import scanned, unset
from openarm_hardware.settings import Settings
from openarm_hardware.upkeep import set_id
from tests.openarm_hardware.bench import made_axes
from tests.openarm_hardware.test_servo_process import PATIENT, UP, Rig
from tests.refusals import refused

pytestmark = pytest.mark.requirement("R-08")


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Callable[..., Rig]]:
    """Makes emulated motors of two arms on one bus."""
    made = list[Rig]()

    def make(motors: int = 16, **options: Any) -> Rig:
        made.append(Rig(tmp_path, made_axes((f"unix:{tmp_path}/can",) * 2)[:motors], **options))
        return made[-1]

    yield make
    for one in made:
        one.close()


def wired(**values: Any) -> Wiring:
    return load_wiring().model_copy(update=values)


def test_all_motors_of_two_arms_on_one_bus_are_found_and_come_up(rig: Callable[..., Rig]) -> None:
    bench = rig()
    found = scanned([bench.axes[0].bus], wired())
    assert [(motor.id, motor.reply_id) for motor in found] == [(i, i + 0x10) for i in range(1, 17)]
    assert {motor.status for motor in found} == {"disabled"}
    assert found[15].q == pytest.approx(0.02 * -23.8, abs=1e-3)
    assert unset(found, wired()) == []
    servo = bench.up()
    states = bench.ask()
    assert all(states[axis.joint]["on"] for axis in bench.axes)
    bench.ask(fault="error", joint="two_finger", value=8)
    state = bench.until(servo, lambda state: state.phases == (Phase.HELD, Phase.DAMPED))
    assert "two_finger (motor 0x10" in state.text
    assert "over voltage or under voltage" in state.text


class Wire(Bus):
    """A bus on which each question comes back with answers; what another process asks on it is seen too."""

    def __init__(self, answers: Callable[[int], list[int]], foreign: Sequence[Frame] = ()) -> None:
        super().__init__("wire")
        self._answers, self._waiting = answers, list(foreign)

    def receive(self) -> list[Frame]:
        came, self._waiting = self._waiting, []
        return came

    def send(self, frames: Sequence[Frame]) -> int:
        for _, (motor, _, _, register, *_) in frames:
            reply = register_reply(motor, register, 1.0, written=False)
            self._waiting += [(number, reply) for number in self._answers(motor)]
        return len(frames)

    def close(self) -> None:
        pass


def test_two_motors_of_one_id_are_named_and_given_no_other_id(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    numbers = {3: [0x13, 0x13], 5: [0x15, 0], 6: [0x16], 200: [0]}
    monkeypatch.setattr(scan, "open_bus", lambda *_, **__: Wire(lambda motor: numbers.get(motor, [])))
    found = scanned(["unix:x"], wired())
    assert [(motor.id, motor.reply_id) for motor in found] == [(3, 19), (3, 19), (5, 0), (5, 21), (6, 22), (200, 0)]
    three, five, far = unset(found, wired())
    assert three == (
        "2 motors answer to id 3 on unix:x; connect one of them alone and type"
        " `openarm hardware set-id unix:x 3 --to 1`, or another id"
    )
    assert five.startswith("2 motors answer to id 5 on unix:x; ")
    assert far.endswith("type `openarm hardware set-id unix:x 200 --to ID`")
    monkeypatch.setattr(upkeep, "open_bus", lambda *_, **__: Wire(lambda motor: numbers.get(motor, [])))
    refused("2 motors answer to id 3 on unix:", set_id, f"unix:{tmp_path}/x", 3, 9, 0x10, flexible=True)


def test_questions_of_another_process_are_no_motors() -> None:
    asks = [read_register(motor, Register.MST_ID) for motor in (3, 9)]
    # both processes have asked motor 3, which has answered both
    assert scan.answering(Wire(lambda motor: [0x13, 0x13] if motor == 3 else [], asks)) == [(3, 0x13)]


def test_motors_fresh_from_the_factory_are_named_and_set_up(rig: Callable[..., Rig]) -> None:
    bench = rig()
    bus = bench.axes[0].bus
    for joint in ("one_1", "one_2"):
        bench.ask(fault="factory", joint=joint)
    answer = commands.scan((bus,))
    assert (answer.success, answer.code) == (False, Code.NOT_READY)
    assert "motors 1 and 2 answer on id 0: not set up" in answer.message
    assert f"`openarm hardware set-id {bus} 1`, `openarm hardware set-id {bus} 2`" in answer.message
    assert len(answer.data["motors"]) == 16
    assert "set-id" in check_motors(bus, wired()).advice
    for motor in (1, 2):
        assert (
            commands.set_id(bus, motor).message
            == f"motor {motor} of {bus} has id {motor:#x} now, and answers with {motor + 16:#x}"
        )
    assert commands.scan((bus,)).success
    bench.ask(fault="power")
    bench.ask(fault="clear")
    assert commands.scan((bus,)).message == "16 motors answer", "they keep it without power"
    assert check_motors(bus, wired()).level == "ok"
    bench.up()


def test_an_id_is_changed_unless_another_motor_has_it(rig: Callable[..., Rig]) -> None:
    bench = rig(motors=8)
    bus = bench.axes[0].bus
    change = partial(set_id, bus, offset=0x10, flexible=True)
    change(3, 31)
    assert [motor.id for motor in scanned([bus], wired())] == [1, 2, *range(4, 9), 31]
    bench.ask(fault="error", joint="one_5", value=12)
    for motor, to, code, text in (
        (4, 2, Code.INVALID_ARGUMENT, "id 2 is that of motor 2"),
        (4, 17, Code.INVALID_ARGUMENT, "id 17 is that of motor 1 or of its replies"),
        (4, 15, Code.INVALID_ARGUMENT, "id 31 is that of motor 31"),
        (4, 32, Code.INVALID_ARGUMENT, "can't be 32, expected 1 to 31"),
        (3, 3, Code.NOT_READY, "motor 3 does not answer.*motors that do: 1, 2, 4"),
        (5, 9, Code.NOT_READY, "motor 5 is not off but rotor too hot"),
    ):
        assert refused(text, change, motor, to).code is code


@pytest.mark.parametrize("flexible", [True, False])
def test_a_bus_that_carries_the_other_kind_of_frames_is_said(rig: Callable[..., Rig], flexible: bool) -> None:
    bench = rig(flexible=flexible)
    bus = bench.axes[0].bus
    wrong, right = wired(flexible=not flexible), wired(flexible=flexible)
    assert scanned([bus], wrong) == []
    finding = check_motors(bus, wrong)
    kind = "frames of CAN FD" if flexible else "classic frames"
    assert (finding.level, finding.observed) == ("error", f"16 motors answer on {bus} to {kind} alone")
    assert finding.advice == f"set `flexible: {str(flexible).lower()}` in hardware.yaml"
    finding = check_motors(bus, right)
    assert (finding.level, finding.observed) == ("ok", "16 answer")
    servo = bench.servo(replace(PATIENT, flexible=flexible))
    bench.until(servo, lambda state: state.phases == UP)
    assert check_motors(bus, right).level == "note"


def test_an_interface_that_takes_classic_frames_alone_is_silent_and_not_lost(monkeypatch: pytest.MonkeyPatch) -> None:
    class Classic(Bus):
        def receive(self) -> list[Frame]:
            return []

        def send(self, frames: Sequence[Frame]) -> int:
            raise OSError(errno.EINVAL, "Invalid argument")

        def close(self) -> None:
            pass

    monkeypatch.setattr(scan, "open_bus", lambda address, *, flexible: Classic(address))
    assert scanned(["socketcan:can0"], wired()) == []


def test_a_bus_without_motors_is_said_to_be_silent(rig: Callable[..., Rig]) -> None:
    bench = rig()
    bench.ask(fault="power")
    answer = commands.scan((bench.axes[0].bus,))
    assert not answer.success
    assert "neither to frames of CAN FD nor to classic ones; is the arm's power on" in answer.message
    finding = check_motors("unix:/none", wired())
    assert (finding.level, "can't open unix:/none" in finding.observed) == ("error", True)


def test_a_joint_that_turns_without_end_is_refused_with_what_to_write() -> None:
    robot = RobotDescription.load()
    name = robot.arm_joints(robot.arm_names[0])[6]
    joint = replace(robot.joint(name), type="continuous", lower=-math.inf, upper=math.inf)
    error = refused(
        f'joint {name!r} turns without end, .* type="revolute"', axes_of, load_wiring(), robot._with_joints(joint)
    )
    assert error.code is Code.CONFIG_INVALID


def test_ids_are_those_of_each_arm_and_doubles_on_a_bus_are_refused() -> None:
    robot, wiring = RobotDescription.load(), load_wiring()
    first, second = robot.arm_names

    def arms(**ids: tuple[int, ...]) -> Wiring:
        both = {arm: ArmWiring(bus="socketcan:can0", ids=ids.get(arm, ())) for arm in robot.arm_names}
        return wiring.model_copy(update={"arms": both})

    axes = axes_of(arms(**{second: tuple(range(9, 17))}), robot)
    assert [axis.id for axis in axes] == list(range(1, 17))
    assert {axis.bus for axis in axes_of(arms(**{second: tuple(range(9, 17))}), robot, {first: "a", second: "b"})} == {
        "a"
    }
    for wrong, texts in (
        ((), (f"to {axes[0].joint} (motor 1) and to {axes[8].joint} (motor 1)", f"arms.{second}.ids: [9, 10, 11")),
        (tuple(range(8, 16)), ("(motor 8)", "the same id 0x8 on socketcan:can0")),
        (tuple(range(17, 25)), (f"from {axes[0].joint} (motor 1) and to {axes[8].joint} (motor 17)",)),
        (tuple(range(9, 16)), ("has 7 values, expected 8: one for each joint, and the gripper's",)),
    ):
        error = refused("hardware.yaml", axes_of, arms(**{second: wrong}), robot)
        assert error.code is Code.CONFIG_INVALID
        for text in texts:
            assert text in error.message


def test_more_motors_than_a_bus_carries_are_refused_with_the_rate() -> None:
    axes = made_axes(("unix:a", "unix:a"))
    check_load(axes, Settings())
    check_load(axes[:8], Settings(flexible=False))
    error = refused(
        "16 motors in classic frames take 3.8 ms on unix:a, of 4.0 ms", check_load, axes, Settings(flexible=False)
    )
    assert (error.code, "`motors.rate` to 182 Hz or less" in error.message) == (Code.CONFIG_INVALID, True)
    check_load(axes, Settings(flexible=False, period_s=1.0 / 182.0))
