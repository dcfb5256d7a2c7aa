# SPDX-License-Identifier: Apache-2.0
"""Frames of a camera: streams matched by stamp, and the posture of the robot at that stamp."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.camera.stream import FrameStream
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.posture import JointNeed, PostureTracker
from tests.refusals import refused, refuses

MS = 1_000_000
ROBOT = RobotDescription.load()
ARM = ROBOT.arm_joints("left")
HAND, BASE = "openarm_left_hand", ROBOT.root


# --- matching by stamp
class Camera:
    """Two streams without a robot, and the frames that come of them."""

    def __init__(self, **options) -> None:
        self.stream: FrameStream[str] = FrameStream(("color", "depth"), **options)
        self.frames: list[tuple[int, dict[str, str]]] = []

    def add(self, stream: str, t_ns: int, item: str = "", frame_id: str = "optical") -> None:
        self.stream.add(stream, t_ns, frame_id, item or f"{stream[0]}{t_ns}", 0.0)
        frame = self.stream.take(0.0)
        if frame is not None:
            self.frames.append((frame.t_ns, dict(frame.items)))

    @property
    def stamps(self) -> list[int]:
        return [t for t, _ in self.frames]


def test_equal_stamps_make_a_frame_in_any_order() -> None:
    camera = Camera()
    for stream, t in (("color", 10), ("depth", 10), ("depth", 20), ("color", 20)):
        camera.add(stream, t)
    assert camera.frames == [(10, {"color": "c10", "depth": "d10"}), (20, {"color": "c20", "depth": "d20"})]
    assert camera.stream.counts["incomplete"] == 0


def test_different_stamps_never_make_a_frame() -> None:
    camera = Camera()
    for t in range(0, 100, 10):
        camera.add("color", t)
        camera.add("depth", t + 1)
    assert camera.frames == []
    assert camera.stream.counts["incomplete"] == 15, "five of twenty may still become complete"


def test_a_lost_message_costs_its_frame_only() -> None:
    camera = Camera()
    for stream, t in (("color", 10), ("color", 20), ("depth", 20), ("depth", 10)):
        camera.add(stream, t)
    assert camera.stamps == [20]
    assert camera.stream.counts["incomplete"] == 1


def test_time_may_start_again() -> None:
    """A restarted simulation stamps from zero: what waits from before does not block it, nor does the rate."""
    camera = Camera(max_rate=10.0)
    for t in (1000, 1010, 1020):
        camera.add("color", t * MS)
    for t in (1000, 0, 100, 150, 200):
        camera.add("color", t * MS)
        camera.add("depth", t * MS)
    assert camera.stamps == [1000 * MS, 0, 100 * MS, 200 * MS]


def test_cleared_items_are_gone() -> None:
    camera = Camera()
    camera.add("color", 10)
    camera.stream.clear()
    camera.add("depth", 10)
    assert camera.frames == []
    assert camera.stream.silent == ["color"]


def test_an_item_in_another_frame_is_refused_by_name() -> None:
    camera = Camera(frame_id="optical")
    with refuses(Code.BAD_IMAGE, "depth is in frame 'link', expected the optical frame 'optical'"):
        camera.add("depth", 10, frame_id="link")
    assert camera.stream.silent == ["color", "depth"]


# --- waiting for the posture
class Eye:
    """A camera on the robot; joint states and time come as the test says. The default wait exceeds any test, s."""

    def __init__(self, wait: float = 60.0, frame: str = HAND, joints: JointNeed = "none", **options) -> None:
        self.tracker = PostureTracker(ROBOT, wait)
        self.tracker.listen(True, 0.0)
        self.frame, self.now = frame, 0.0
        self.stream: FrameStream[int] = FrameStream(("depth",), self.tracker, joints=joints, **options)

    def at(self, t_ms: int, q: float) -> None:
        self.tracker.add(t_ms * MS, ARM, [q] * len(ARM), self.now)

    def image(self, t_ms: int):
        self.stream.add("depth", t_ms * MS, self.frame, t_ms, self.now)
        return self.take()

    def take(self):
        return self.stream.take(self.now)


@pytest.mark.parametrize(("frame", "joints"), [(HAND, "none"), (BASE, "required"), (BASE, "optional")])
@pytest.mark.requirement("B-61")
def test_a_frame_waits_for_the_joint_state_after_its_stamp(frame: str, joints: JointNeed) -> None:
    """However near the one before is; and is then between the two."""
    eye = Eye(frame=frame, joints=joints)
    assert eye.image(103) is None
    for t in (70, 80, 90, 100):
        eye.at(t, 1e-3 * t)
        assert eye.take() is None
    eye.at(110, 0.11)
    found = eye.take().posture
    between = dict.fromkeys(ARM, 0.103)
    np.testing.assert_allclose(found.T_base_frame, ROBOT.link_pose(frame, between), atol=1e-12)
    assert found.joints == (pytest.approx(between) if joints != "none" else {})
    assert eye.stream.waiting_ns is None


def test_a_frame_that_no_joint_moves_waits_for_none() -> None:
    np.testing.assert_array_equal(Eye(frame=BASE).image(103).posture.T_base_frame, np.eye(4))


@pytest.mark.requirement("B-61")
def test_a_frame_whose_joint_state_can_no_longer_come_is_refused_at_once() -> None:
    """The joint states are past its stamp, or not subscribed to; within the first wait it is given up in silence."""
    eye = Eye(wait=5.0)
    eye.at(120, 0.0)
    assert eye.image(103) is None
    assert (eye.stream.counts["early"], eye.stream.waiting_ns) == (1, None)
    eye.now = 6.0
    refused(r"the nearest is \+17.0 ms away", eye.image, 103)
    eye.tracker.listen(False, 6.0)
    refused(r"the nearest is -80.0 ms away", eye.image, 200)
    assert eye.stream.counts["refused"] == 2


@pytest.mark.requirement("B-61")
def test_after_the_wait_the_nearest_joint_state_within_tolerance_is_used_or_the_lack_named() -> None:
    eye = Eye(wait=0.5, joints="required")
    eye.at(100, 0.2)
    assert eye.image(103) is None
    assert eye.image(200) is None
    eye.now = 0.6
    taken = eye.take()
    assert (taken.t_ns, dict(taken.posture.joints)) == (103 * MS, dict.fromkeys(ARM, 0.2))
    assert eye.stream.counts["refused"] == 1
    eye.now = 10.0
    assert refused(r"the nearest is -300.0 ms away", eye.image, 400).code is Code.STALE_DATA


def test_a_frame_that_is_not_connected_yet_is_waited_for_and_then_named() -> None:
    eye = Eye(wait=0.5, frame="camera")
    assert eye.image(103) is None
    eye.tracker.buffer.set_static(BASE, "camera", np.eye(4))
    assert eye.take() is not None
    other = Eye(wait=0.5, frame="lens")
    assert other.image(103) is None
    other.now = 0.6
    assert refused(None, other.take).code is Code.NO_TRANSFORM


def test_optional_joints_without_a_publisher_are_named_and_the_frame_is_used() -> None:
    eye = Eye(wait=0.5, frame=BASE, joints="optional")
    assert eye.image(103) is None
    eye.now = 1.1
    posture = eye.take().posture
    assert (posture.joints, "no /joint_states yet" in posture.lack) == ({}, True)


@pytest.mark.requirement("B-61")
def test_the_newest_frame_that_can_be_answered_is_taken_and_older_ones_given_up() -> None:
    eye = Eye()
    eye.at(0, 0.0)
    for t in (10, 43, 76, 110):
        assert eye.image(t) is None
    eye.at(80, 0.0)
    assert eye.take().t_ns == 76 * MS
    assert (eye.stream.counts["superseded"], eye.stream.counts["taken"]) == (2, 1)
    assert eye.stream.waiting_ns == 110 * MS


def test_the_queue_is_bounded_and_counts_what_it_drops() -> None:
    """While the oldest waits for a joint state it is kept: faster images must not push out all that may be answered."""
    eye = Eye(capacity=3, frame=BASE)
    for t in range(10):
        eye.stream.add("depth", t * MS, BASE, t, eye.now)
    assert eye.stream.counts["overrun"] == 7
    assert eye.take().t_ns == 9 * MS
    eye = Eye(capacity=3)
    for t in range(10):
        eye.image(t)
    assert eye.stream.counts["overrun"] == 7
    eye.at(0, 0.0)
    eye.at(100, 0.0)
    assert eye.take().t_ns == 2 * MS


def test_the_pose_of_another_frame_can_be_asked_for() -> None:
    eye = Eye(frame="unknown_mount", joints="required", pose_of=BASE)
    eye.at(0, 0.5)
    taken = eye.image(0)
    assert (taken.frame_id, set(taken.posture.joints)) == ("unknown_mount", set(ARM))
