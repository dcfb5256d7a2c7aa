# SPDX-License-Identifier: Apache-2.0
"""`openarm calibrate touch` before a robot that rests, and one that moves."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sensor_msgs.msg import JointState

from openarm_bringup.commands.calibrate_touch import touch
from openarm_calibration.handeye.touch import read_touches
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.node import QOS_COMMAND


@contextmanager
def joint_states(ros, step: float) -> Iterator[None]:
    """A robot whose joints go so far from one state to the next, rad."""
    names = [name for arm in RobotDescription.load().arms.values() for name in arm.joints]
    publisher, ended = ros.node.create_publisher(JointState, "/joint_states", QOS_COMMAND), threading.Event()

    def publish() -> None:
        count = 0
        while not ended.wait(0.005):
            count += 1
            publisher.publish(JointState(name=names, position=[0.1 + step * count] * len(names)))

    thread = threading.Thread(target=publish)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
        ros.node.destroy_publisher(publisher)


def test_a_touch_is_where_the_arm_rests(ros, tmp_path: Path) -> None:
    path = tmp_path / "touches.csv"
    with joint_states(ros, 0.0):
        outcome = touch(path, mark=7, arm="left")
    (found,) = read_touches(path)
    assert outcome.success
    assert found.mark == 7
    assert dict(found.joints) == pytest.approx(dict.fromkeys(RobotDescription.load().arms["left"].joints, 0.1))
    with joint_states(ros, 0.01), pytest.raises(OpenArmError, match="moves") as moving:
        touch(path, mark=7, arm="left")
    assert moving.value.code is Code.MOVING
    with pytest.raises(OpenArmError, match="expected one of left, right"):
        touch(path, mark=7)
    assert len(read_touches(path)) == 1
