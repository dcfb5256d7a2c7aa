# SPDX-License-Identifier: Apache-2.0
"""A bus behind python-can, on the library's virtual interface."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from openarm_common.errors import Code, OpenArmError
from openarm_common.motors import frames
from openarm_common.motors.axis import Axis
from openarm_common.motors.bus import Bus, open_bus
from openarm_common.motors.emulated import EmulatedBuses, EmulatedMotor

can: Any = pytest.importorskip("can", reason="needs python-can: install the extra `can`")
pytestmark = pytest.mark.requirement("R-08")
ADDRESS = "python-can:virtual:openarm"


@pytest.fixture
def both() -> Iterator[tuple[Bus, Any]]:
    far = can.Bus(interface="virtual", channel="openarm", protocol=can.CanProtocol.CAN_FD)
    bus = open_bus(ADDRESS)
    yield bus, far
    bus.close()
    far.shutdown()


def test_frames_pass_both_ways_as_can_fd(both: tuple[Bus, Any]) -> None:
    bus, far = both
    assert bus.send([(1, bytes(8)), (0x7FF, b"\1\0\xcc")]) == 2
    first, second = far.recv(1.0), far.recv(1.0)
    assert (first.arbitration_id, bytes(first.data), first.is_fd, first.bitrate_switch) == (1, bytes(8), True, True)
    assert not first.is_extended_id
    assert (second.arbitration_id, bytes(second.data)) == (0x7FF, b"\1\0\xcc")
    far.send(can.Message(arbitration_id=0x11, data=b"abcdefgh", is_extended_id=False))
    assert bus.receive() == [(0x11, b"abcdefgh")]
    assert bus.receive() == []


def test_what_is_no_frame_of_a_motor_is_left_out(both: tuple[Bus, Any]) -> None:
    bus, far = both
    far.send(can.Message(arbitration_id=0x12345, data=b"x", is_extended_id=True))
    far.send(can.Message(arbitration_id=0x11, is_remote_frame=True, is_extended_id=False))
    far.send(can.Message(is_error_frame=True))
    assert bus.receive() == []
    assert (bus.ignored, bus.errors) == (2, 1)


def test_an_emulated_motor_answers_on_it(both: tuple[Bus, Any]) -> None:
    bus, far = both
    limits = (-2.0, 2.0, 16.0, 70.0, 2.0, 5.0, 10.0)
    axis = Axis("joint", "arm", ADDRESS, 3, 0x13, "DM4310", 1.0, 0.0, *limits, grips=False)
    motors = EmulatedBuses([EmulatedMotor(axis, 0.4)])
    bus.send([frames.refresh(3)])
    asked = far.recv(1.0)
    for number, data in motors.take(ADDRESS, [(asked.arbitration_id, bytes(asked.data))], 0):
        far.send(can.Message(arbitration_id=number, data=data, is_extended_id=False, is_fd=True))
    ((number, data),) = bus.receive()
    state = frames.decode_feedback(frames.motor_type("DM4310"), data)
    assert number == 0x13
    assert state is not None
    assert state.q == pytest.approx(0.4, abs=1e-3)


def test_an_interface_that_does_not_exist_is_refused() -> None:
    with pytest.raises(OpenArmError, match="can't open python-can:none:x") as refused:
        open_bus("python-can:none:x")
    assert refused.value.code is Code.ENVIRONMENT
