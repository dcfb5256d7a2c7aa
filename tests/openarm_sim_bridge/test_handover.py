# SPDX-License-Identifier: Apache-2.0
"""States on their way to the process that draws: complete, newest first, and no side that waits for the other."""

from __future__ import annotations

import math
import socket
from collections.abc import Iterator

import mujoco
import numpy as np
import pytest

from openarm_common.camera.cameras import CameraConfig
from openarm_sim_bridge.cameras.handover import CameraReport, CameraSetup, StateReceiver, StateSender, pair
from openarm_sim_bridge.cameras.noise import ColourNoiseConfig, DepthNoiseConfig
from openarm_sim_bridge.world.world import Snapshot

MODEL = """<mujoco><worldbody><body name="{0}"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


def camera(name: str) -> CameraConfig:
    return CameraConfig(name=name, parent="world", position=(0, 0, 1), forward=(0, 0, -1), image_right=(0, -1, 0))


SETUP = CameraSetup((camera("a"), camera("b")), "16UC1", {}, DepthNoiseConfig(), ColourNoiseConfig())


def snapshot(t_ns: int, model: mujoco.MjModel) -> Snapshot:
    return Snapshot(model, t_ns, np.full(7, t_ns * 0.1))


def model(name: str = "ball") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(MODEL.format(name))


@pytest.fixture
def ends() -> Iterator[tuple[StateSender, StateReceiver, socket.socket]]:
    ours, theirs = pair()
    sender = StateSender(ours, SETUP)
    yield sender, StateReceiver(theirs), theirs
    ours.close()
    theirs.close()


def test_states_arrive_with_their_model_and_cameras(ends) -> None:
    sender, receiver, _ = ends
    assert receiver.setup == SETUP
    assert receiver.take(0.0) is None
    m = model()
    assert sender.offer(snapshot(5, m), ["b"])
    work = receiver.take(1.0)
    assert work is not None
    assert (work.snapshot.t_ns, work.names) == (5, {"b"})
    np.testing.assert_array_equal(work.snapshot.qpos, np.full(7, 0.5))
    assert work.snapshot.model.body(1).name == "ball"
    sender.offer(snapshot(6, m), ["a"])
    again = receiver.take(1.0)
    assert again is not None
    assert again.snapshot.model is work.snapshot.model  # handed over once
    sender.offer(snapshot(7, model("cube")), ["a"])
    other = receiver.take(1.0)
    assert other is not None
    assert other.snapshot.model.body(1).name == "cube"


def test_the_newest_state_is_drawn_and_no_camera_is_forgotten(ends) -> None:
    sender, receiver, _ = ends
    m = model()
    for t_ns, names in ((10, ["a"]), (20, ["b"]), (30, ["a"])):
        sender.offer(snapshot(t_ns, m), names)
    work = receiver.take(1.0)
    assert work is not None
    assert (work.snapshot.t_ns, work.names) == (30, {"a", "b"})
    assert receiver.dropped == 3  # a of 10, then a and b of 20
    assert receiver.take(0.0) is None


def test_a_side_that_does_not_listen_blocks_no_one(ends) -> None:
    sender, receiver, _ = ends
    m = model()
    taken = [sender.offer(snapshot(t, m), ["a"]) for t in range(20000)]
    assert taken[0]
    assert not taken[-1]
    assert receiver.take(1.0) is not None
    assert sender.offer(snapshot(9, m), ["a"])


def test_reports_come_back(ends) -> None:
    sender, receiver, _ = ends
    assert sender.reports() == []
    report = CameraReport(ready=True, rates={"a": 30.0, "b": math.inf}, rendered={"a": 3, "b": 0}, dropped=1)
    receiver.report(report)
    sender.wait(1.0)
    assert sender.reports() == [report]


def test_each_side_sees_the_end_of_the_other() -> None:
    ours, theirs = pair()
    sender = StateSender(ours, SETUP)
    receiver = StateReceiver(theirs)
    sender.close()
    with pytest.raises(EOFError):
        receiver.take(1.0)
    ours, theirs = pair()
    sender = StateSender(ours, SETUP)
    theirs.close()
    with pytest.raises(EOFError):
        sender.reports()
    assert not sender.offer(snapshot(1, model()), ["a"])
    sender.close()
    ours, theirs = pair()
    ours.close()
    with pytest.raises(EOFError):
        StateReceiver(theirs)
    theirs.close()
