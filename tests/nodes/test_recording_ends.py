# SPDX-License-Identifier: Apache-2.0
"""However the process of a recording ends, what it leaves can be read: Ctrl-C, SIGKILL, a file that can't grow.

And what comes while it is held up is not lost.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.duration import Duration
from rclpy.executors import SingleThreadedExecutor
from sensor_msgs.msg import Image
from std_msgs.msg import String

from openarm_bringup.bags.bag import open_bag
from openarm_bringup.supervision.environment import profiled, write_profile
from openarm_bringup.supervision.graph import NodeSpec
from openarm_common.convert import array_to_image
from openarm_common.node import QOS_COMMAND, QOS_SENSOR

TOPIC = "/overhead/color/image_raw"


def small_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000_000, 5_000_000))


@pytest.mark.parametrize(
    ("ending", "limit", "exit_code"),
    [
        pytest.param(signal.SIGINT, None, 0, id="ctrl_c"),
        pytest.param(signal.SIGKILL, None, -9, id="killed"),
        pytest.param(None, small_files, 1, id="no_room"),
    ],
)
def test_what_was_recorded_can_be_read(
    ros, tmp_path: Path, ending: signal.Signals | None, limit: Callable[[], None] | None, exit_code: int
) -> None:
    images = ros.node.create_publisher(Image, TOPIC, QOS_COMMAND)
    noise = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)  # does not get smaller
    command = [sys.executable, "-m", "openarm_bringup.cli", "record", "bag", "--topics", TOPIC, "--json"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True, preexec_fn=limit)
    try:
        ros.spin_until(images.get_subscription_count, 30.0, "the recorder subscribes")
        file = tmp_path / "bag" / "bag.mcap"
        for i in range(1000):
            images.publish(array_to_image(noise, "rgb8", "optical", i))
            images.wait_for_all_acked()
            if process.poll() is not None or (ending and file.stat().st_size > 4_000_000):
                break
        if ending:
            process.send_signal(ending)
        out, _ = process.communicate(timeout=20.0)
        assert process.returncode == exit_code
    finally:
        process.kill()
        process.communicate()
    if ending != signal.SIGKILL:
        answer = json.loads(out)
        assert answer["success"] == (exit_code == 0), answer["message"]
        assert ("File too large" in answer["message"]) == (ending is None)
    with open_bag(tmp_path / "bag") as bag:
        assert (bag.mended is None) == (ending == signal.SIGINT)
        assert bag.counts[TOPIC] >= 3
        assert all(len(record.data) > noise.nbytes for record in bag.records())


def test_what_comes_while_the_recorder_is_held_up_is_not_lost(tmp_path: Path) -> None:
    """As on a busy machine: a second of a graph, twice what Fast DDS keeps for a process by itself."""
    topics = [f"/stream_{i}" for i in range(8)]
    command = [sys.executable, "-m", "openarm_bringup.cli", "record", "bag", "--topics", "/stream_.*", "--json"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    context = Context()
    spec = NodeSpec(module="bridge", large_messages=True, segment_mib=8)
    with profiled(write_profile(spec, tmp_path / "fastdds.xml")):
        rclpy.init(context=context)
        node = rclpy.create_node("streams", context=context)
    executor = SingleThreadedExecutor(context=context)
    streams = [node.create_publisher(String, topic, QOS_SENSOR) for topic in topics]
    last = node.create_publisher(String, "/stream_last", QOS_COMMAND)  # met last, and that is acknowledged
    process = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 30.0
        while not all(stream.get_subscription_count() for stream in (*streams, last)):
            assert time.monotonic() < deadline, "the recorder subscribes"
            rclpy.spin_once(node, executor=executor, timeout_sec=0.05)
        last.publish(String())
        assert last.wait_for_all_acked(Duration(seconds=10))
        process.send_signal(signal.SIGSTOP)
        for i in range(150):
            for stream in streams:
                stream.publish(String(data=str(i)))
        process.send_signal(signal.SIGCONT)
        last.publish(String())  # behind all of them in the queue
        assert last.wait_for_all_acked(Duration(seconds=10))
        process.send_signal(signal.SIGINT)
        out, _ = process.communicate(timeout=20.0)
    finally:
        process.kill()
        process.communicate()
        node.destroy_node()
        context.try_shutdown()
    told = json.loads(out)
    assert (told["messages"], told["lost"]) == (1202, 0), told["message"]
