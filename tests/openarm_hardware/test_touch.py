# SPDX-License-Identifier: Apache-2.0
"""Commands that would let a robot touch itself, on a ball that hangs over a box."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.collision.self_collision import SelfCollision
from openarm_common.robot.description import RobotDescription
from openarm_hardware.touch import KEEP, TouchGuard
from tests.openarm_common.test_self_collision import PENDULUM

pytestmark = pytest.mark.requirement("R-08")
#: Length of the rod at which the ball touches the box.
TOUCHES = 0.25
STILL = np.zeros(2)


def at(length: float, turn: float = np.pi) -> np.ndarray:
    return np.array([turn, length])


@pytest.fixture
def guard() -> TouchGuard:
    return TouchGuard(SelfCollision(RobotDescription.from_urdf(PENDULUM), ["a", "b"]))


def test_a_command_stops_before_the_links_touch_and_names_them(guard: TouchGuard) -> None:
    why, length = "", 0.0
    for length in np.arange(0.20, 0.30, 0.002):
        if why := guard.refused(at(length), at(length - 0.002), STILL):
            break
    assert "tip" in why
    assert "base" in why
    assert TOUCHES - 0.002 < length < TOUCHES + 1e-9


def test_a_command_that_creeps_is_stopped_too(guard: TouchGuard) -> None:
    length = 0.24
    while not guard.refused(at(length), at(length), STILL):
        length += 0.00005
        assert length < TOUCHES


def test_an_arm_that_moves_where_nobody_commands_it_is_stopped(guard: TouchGuard) -> None:
    assert guard.refused(at(0.2), at(0.2), STILL) == ""
    assert guard.refused(at(0.2), at(TOUCHES - KEEP), np.array([0.0, 0.04])) == ""
    assert "tip moves to touch base" in guard.refused(at(0.2), at(TOUCHES - KEEP), np.array([0.0, 0.2]))


def test_links_that_touch_at_the_start_may_part_and_not_come_nearer(guard: TouchGuard) -> None:
    leaning = at(TOUCHES + 0.01)
    assert guard.refused(leaning, leaning, STILL) == ""
    assert guard.refused(at(TOUCHES + 0.005), leaning, STILL) == ""
    assert guard.refused(at(TOUCHES + 0.005), at(TOUCHES + 0.005), STILL) == ""
    assert "to touch" in guard.refused(at(TOUCHES + 0.02), at(TOUCHES + 0.005), STILL)
    assert "to touch" in guard.refused(leaning, at(TOUCHES + 0.005), STILL), "it has parted"
    guard.begin()
    assert guard.refused(leaning, leaning, STILL) == ""
