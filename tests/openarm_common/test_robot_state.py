# SPDX-License-Identifier: Apache-2.0
"""Lookups at the stamp of an image: answered exactly, or refused with the gap."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer

MS = 1_000_000
URDF = """<robot name="two">
  <link name="base"/><link name="arm"/><link name="hand"/>
  <joint name="lift" type="prismatic"><parent link="base"/><child link="arm"/><axis xyz="0 0 1"/>
    <limit lower="0" upper="1" effort="1" velocity="1"/></joint>
  <joint name="fix" type="fixed"><parent link="arm"/><child link="hand"/><origin xyz="0.1 0 0" rpy="0 0 0"/></joint>
</robot>"""


@pytest.fixture
def buffer() -> RobotStateBuffer:
    return RobotStateBuffer(RobotDescription.from_urdf(URDF))


@given(st.integers(0, 10 * MS))
@pytest.mark.requirement("A-44")
def test_interpolates_between_two_that_bracket(t_ns: int) -> None:
    buffer = RobotStateBuffer(RobotDescription.from_urdf(URDF))
    buffer.add_joint_state(0, ["lift"], [0.0])
    buffer.add_joint_state(10 * MS, ["lift"], [0.1])
    assert buffer.joints_at(t_ns)["lift"] == pytest.approx(0.1 * t_ns / (10 * MS))


@pytest.mark.parametrize(("offset_ms", "accepted"), [(-5, True), (5, True), (6, False), (-6, False), (20, False)])
@pytest.mark.requirement("A-72")
def test_beyond_the_ends_five_milliseconds_are_the_limit(
    buffer: RobotStateBuffer, offset_ms: int, accepted: bool
) -> None:
    buffer.add_joint_state(100 * MS, ["lift"], [0.3])
    if accepted:
        assert buffer.joints_at((100 + offset_ms) * MS)["lift"] == 0.3
        return
    with pytest.raises(OpenArmError) as caught:
        buffer.joints_at((100 + offset_ms) * MS)
    assert caught.value.code is Code.STALE_DATA
    assert f"{-offset_ms:+.1f} ms" in caught.value.message


def test_a_gap_in_the_joint_states_is_not_bridged(buffer: RobotStateBuffer) -> None:
    buffer.add_joint_state(0, ["lift"], [0.0])
    buffer.add_joint_state(500 * MS, ["lift"], [0.5])
    with pytest.raises(OpenArmError, match="nearest"):
        buffer.joints_at(250 * MS)


@pytest.mark.requirement("B-33")
def test_nothing_yet_is_an_answer(buffer: RobotStateBuffer) -> None:
    with pytest.raises(OpenArmError, match="no /joint_states yet"):
        buffer.joints_at(0)
    with pytest.raises(OpenArmError, match="no /joint_states yet"):
        buffer.latest()


def test_lookup_goes_through_static_edges_and_moving_links(buffer: RobotStateBuffer) -> None:
    buffer.add_joint_state(10 * MS, ["lift"], [0.5])
    buffer.set_static("hand", "camera", se3.make(None, (0.0, 0.2, 0.0)))
    buffer.set_static("base", "table", se3.make(None, (0.0, 0.0, 0.4)))
    T = buffer.lookup("table", "camera", 10 * MS)
    assert np.allclose(T[:3, 3], (0.1, 0.2, 0.1))


def test_fixed_frames_need_no_joint_state(buffer: RobotStateBuffer) -> None:
    buffer.set_static("base", "table", se3.make(None, (0.0, 0.0, 0.4)))
    assert np.allclose(buffer.lookup("base", "table", 0)[:3, 3], (0.0, 0.0, 0.4))


@pytest.mark.requirement("B-34")
def test_an_unknown_frame_is_refused_with_the_known_ones(buffer: RobotStateBuffer) -> None:
    with pytest.raises(OpenArmError) as caught:
        buffer.lookup("base", "camera_link", 0)
    assert caught.value.code is Code.NO_TRANSFORM
    assert "camera_link" in caught.value.message
    assert "arm, base, hand" in caught.value.message


def test_time_going_back_forgets_the_old_states(buffer: RobotStateBuffer) -> None:
    buffer.add_joint_state(1000 * MS, ["lift"], [0.5])
    buffer.add_joint_state(10 * MS, ["lift"], [0.1])
    assert buffer.latest() == (10 * MS, {"lift": 0.1})
    with pytest.raises(OpenArmError):
        buffer.joints_at(1000 * MS)


def test_a_loop_of_static_edges_ends(buffer: RobotStateBuffer) -> None:
    buffer.set_static("b", "a", np.eye(4))
    buffer.set_static("a", "b", np.eye(4))
    with pytest.raises(OpenArmError, match="not connected"):
        buffer.lookup("base", "a", 0)


def test_a_stamp_is_settled_when_a_state_at_it_or_after_it_is_there(buffer: RobotStateBuffer) -> None:
    assert not buffer.settled(0)
    buffer.add_joint_state(10, ["a"], [0.0])
    assert buffer.settled(10)
    assert not buffer.settled(11)
