# SPDX-License-Identifier: Apache-2.0
"""Zeros, registers and jogs of motors, before a process of emulated ones."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from openarm_bringup.commands import hardware as commands
from openarm_common.collision.self_collision import SelfCollision
from openarm_common.errors import Code
from openarm_common.motors.bus import emulated_buses
from openarm_common.motors.wiring import axes_of, load_wiring
from openarm_common.robot.description import RobotDescription
from openarm_control.joints import arm_loads
from openarm_hardware import jog
from openarm_hardware.jog import Jog
from openarm_hardware.touch import TouchGuard
from openarm_hardware.upkeep import changed, gains, read_gains, zeros
from tests.openarm_hardware.test_servo_process import PATIENT, Rig
from tests.refusals import refused, refuses

pytestmark = pytest.mark.requirement("R-08")
START = 0.3


class RobotRig(Rig):
    """The motors of the robot of this process, all joints at 0.3 rad; without weight."""

    def __init__(self, folder: Path) -> None:
        self.description = RobotDescription.load()
        buses = emulated_buses(0, self.description.arm_names, str(folder))
        self.made = axes_of(load_wiring(), self.description, buses)
        super().__init__(folder, self.made)


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[RobotRig]:
    found = RobotRig(tmp_path)
    yield found
    found.close()


class NoLoad:
    """An arm without weight, as the emulated one is."""

    def torque(self, q: np.ndarray, v: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.zeros_like(q)


def arm_of(rig: RobotRig, arm: str = "right") -> list[Any]:
    return [axis for axis in rig.made if axis.arm == arm]


def test_a_zero_is_announced_and_set_where_the_joint_is(rig: RobotRig) -> None:
    axis = arm_of(rig)[3]
    (would,) = zeros([axis], flexible=True, write=False)
    assert (would.before, would.after) == (pytest.approx(START, abs=1e-3), None)
    assert rig.ask()[axis.joint]["q"] == pytest.approx(START, abs=1e-6)
    (done,) = zeros([axis], flexible=True, write=True)
    assert done.before == pytest.approx(START, abs=1e-3)
    assert done.after == pytest.approx(-axis.offset / axis.ratio, abs=1e-3)
    (other,) = zeros([arm_of(rig)[2]], flexible=True, write=False)
    assert other.before == pytest.approx(START, abs=1e-3)


def test_motors_that_are_commanded_or_silent_get_no_zero(rig: RobotRig) -> None:
    axis = arm_of(rig)[3]
    rig.ask(fault="silent", joint=axis.joint)
    assert refused(f"{axis.joint}.*does not answer", zeros, [axis], flexible=True, write=True).code is Code.NOT_READY
    rig.ask(fault="clear")
    rig.ask(fault="error", joint=axis.joint, value=12)
    refused("not off but rotor too hot", zeros, [axis], flexible=True, write=True)
    rig.servo()
    assert refused("in use by another process", zeros, [axis], flexible=True, write=True).code is Code.BUSY


def test_a_joint_is_moved_there_and_back_and_the_others_stay(rig: RobotRig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(jog, "_REST_S", 0.2)
    axes = arm_of(rig)
    robot = rig.description
    guard = TouchGuard(SelfCollision(robot, [axis.joint for axis in axes]))
    load: Any = NoLoad()
    found = Jog(axes, axes[3].joint, load, guard, replace(PATIENT, release_s=0.1)).run(math.radians(5.0))
    assert found.start == pytest.approx(START, abs=0.01)
    assert found.there - found.start == pytest.approx(math.radians(5.0), abs=0.02)
    assert found.back == pytest.approx(found.start, abs=0.03)
    assert found.others < 0.03
    rows = rig.ask()
    assert not any(rows[axis.joint]["on"] for axis in rig.made)
    assert all(rows[axis.joint]["commands"] == 0 for axis in arm_of(rig, "left")), "the other arm is left alone"


def test_a_jog_that_is_none_is_refused(rig: RobotRig) -> None:
    axes = arm_of(rig)
    guard = TouchGuard(SelfCollision(rig.description, [axis.joint for axis in axes]))
    for name, degrees, code, text in (
        (axes[3].joint, 45.0, Code.INVALID_ARGUMENT, "expected up to 30"),
        (axes[3].joint, -25.0, Code.LIMITS, "is beyond"),
        ("none", 5.0, Code.INVALID_ARGUMENT, "no joint"),
    ):
        with refuses(code, text):
            Jog(axes, name, arm_loads(rig.description)["right"], guard, PATIENT).run(math.radians(degrees))


def test_a_jog_ends_when_a_motor_fails(rig: RobotRig) -> None:
    axes = arm_of(rig)
    guard = TouchGuard(SelfCollision(rig.description, [axis.joint for axis in axes]))
    rig.ask(fault="error", joint=axes[1].joint, value=12)
    load: Any = NoLoad()
    assert refused("rotor too hot", Jog(axes, axes[3].joint, load, guard, PATIENT).run, 0.1).code is Code.NOT_READY


def test_what_is_set_in_the_motors_is_recorded_and_compared(rig: RobotRig, tmp_path: Path) -> None:
    found = gains(rig.made[:2], flexible=True)
    assert set(found) == {axis.joint for axis in rig.made[:2]}
    first = found[rig.made[0].joint]
    assert first["KP_ASR"] == pytest.approx(0.00372)
    assert {"PMAX", "OC_VALUE", "SW_VER", "KI_APR"} <= first.keys()
    assert "TIMEOUT" not in first
    path = tmp_path / "gains.json"
    path.write_text(json.dumps({"motors": found}), encoding="utf-8")
    again = read_gains(path)
    assert changed(again, found) == []
    again[rig.made[0].joint]["KP_ASR"] = 0.004
    del again[rig.made[1].joint]
    assert changed(again, found) == [
        f"{rig.made[0].joint}: KP_ASR was 0.004, is {first['KP_ASR']}",
        f"{rig.made[1].joint} is not in both",
    ]


@pytest.mark.long
def test_commands_ask_before_they_set_a_zero_and_say_what_they_changed(
    rig: RobotRig, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(commands, "_axes", lambda *, emulated: (rig.description, arm_of(rig)[3:4]))
    monkeypatch.setenv("OPENARM_CALIBRATIONS", str(tmp_path))
    joint = arm_of(rig)[3].joint
    asked = commands.zero(joint, emulated=True)
    assert not asked.success
    assert "--yes" in asked.message
    assert rig.ask()[joint]["q"] == pytest.approx(START, abs=1e-6)
    (still,) = zeros([arm_of(rig)[3]], flexible=True, write=False)
    assert still.before == pytest.approx(START, abs=1e-3)
    done = commands.zero(joint, yes=True, emulated=True)
    assert done.success
    assert "was at   0.3000 rad, is at   0.000" in done.text
    refused("no joint or arm 'elbow'; there are", commands.zero, "elbow", yes=True, emulated=True)
    record = commands.record_gains(tmp_path / "gains.json", emulated=True)
    assert record.success, record.message
    same = commands.record_gains(tmp_path / "again.json", against=tmp_path / "gains.json", emulated=True)
    assert same.success, same.text
