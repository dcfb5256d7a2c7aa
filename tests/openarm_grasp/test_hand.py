# SPDX-License-Identifier: Apache-2.0
"""What the joint states say of a hand, and of a robot that has gone silent."""

from __future__ import annotations

import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_grasp.evidence.hand import HandReader, Silence
from tests.refusals import refused

MS = 1_000_000


@pytest.fixture(scope="module")
def robot() -> RobotDescription:
    return RobotDescription.load()


def reader(robot: RobotDescription, *fingers: float) -> HandReader:
    """A hand whose finger was at these positions, 10 ms apart."""
    states = RobotStateBuffer(robot)
    home = robot.group_state("right_arm", "home")
    hand = HandReader(robot, states, "right")
    for i, finger in enumerate(fingers):
        q = home | {hand.joint: finger}
        states.add_joint_state(i * 10 * MS, list(q), list(q.values()))
    return hand


def test_the_gap_is_twice_the_finger(robot):
    assert reader(robot, 0.020).gap() == pytest.approx(0.040)


def test_speed_comes_from_positions_because_drivers_report_none(robot):
    closing = reader(robot, *(0.044 - 0.0005 * i for i in range(12)))
    assert closing.gap_speed() == pytest.approx(-0.1)
    assert reader(robot, *[0.025] * 12).gap_speed() == 0.0


def test_too_short_a_history_has_no_speed(robot):
    assert refused(None, reader(robot, 0.025, 0.025).gap_speed).code is Code.STALE_DATA


def test_evidence_holds_gap_effort_and_distance_from_the_plan(robot):
    hand = reader(robot, *[0.025] * 12)
    planned = hand.T_base_tcp() @ se3.make(p=(0.0, 0.003, 0.004))
    evidence = hand.evidence(0.05, -30.0, planned)
    assert evidence.gap == pytest.approx(0.05)
    assert (evidence.expected, evidence.effort) == (0.05, -30.0)
    assert evidence.tcp_error == pytest.approx(0.005)
    assert hand.evidence(0.05, 0.0, None).tcp_error == 0.0


def test_a_robot_without_the_finger_is_named(robot):
    states = RobotStateBuffer(robot)
    states.add_joint_state(0, ["other"], [0.0])
    refused("no openarm_right_finger_joint1; it has other", HandReader(robot, states, "right").gap)


@pytest.fixture
def silence() -> Silence:
    return Silence(0.2)


def test_no_joint_state_yet_is_not_silence(silence):
    for i in range(100):
        silence.update(i * 0.1, -1)
    silence.check(1.0)


def test_a_second_without_a_new_stamp_is_a_lost_robot(silence):
    silence.update(0.0, 5 * MS)
    for i in range(1, 11):
        silence.update(i * 0.1, 5 * MS)
    silence.check(1.05)
    silence.update(1.1, 5 * MS)
    assert refused(r"silent for 1\.1 s", silence.check, 1.05).code is Code.ROBOT_LOST


def test_a_new_stamp_ends_the_silence(silence):
    for i in range(30):
        silence.update(i * 0.1, i * MS)
        silence.check(0.15)


def test_a_starved_process_does_not_take_its_own_pause_for_silence(silence):
    silence.update(0.0, MS)
    silence.update(30.0, MS)
    silence.check(1.0)


def test_robot_time_that_goes_back_is_a_restarted_robot(silence):
    silence.update(0.0, 100 * MS)
    silence.update(0.1, 2 * MS)
    silence.update(0.2, 3 * MS)
    refused("went back", silence.check, 1.0)
