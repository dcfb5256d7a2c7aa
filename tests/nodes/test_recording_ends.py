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
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensor_msgs.msg import Image

from openarm_bringup.bags import bag
from openarm_bringup.bags.ros import recorder
from openarm_bringup.commands import record
from openarm_bringup.supervision.environment import PROFILE, write_profile
from openarm_bringup.supervision.graph import NodeSpec
from openarm_bringup.supervision.shm import SHM, names_of
from openarm_common.errors import Code
from openarm_common.ros.images import array_to_image
from openarm_common.ros.node import QOS_COMMAND
from tests.conftest import DEADLINE_S
from tests.nodes import streams

TOPIC = "/overhead/color/image_raw"


NOISE = np.random.default_rng(0).integers(0, 255, (480, 640, 3), dtype=np.uint8)  # does not get smaller


def publish_until(images, ended: Callable[[], bool]) -> None:
    for i in range(1000):
        images.publish(array_to_image(NOISE, "rgb8", "optical", i))
        images.wait_for_all_acked()
        if ended():
            return


@pytest.mark.parametrize("full", [False, True])
def test_a_recording_ends_when_it_is_stopped_or_the_disk_is_full(ros, tmp_path: Path, monkeypatch, full: bool) -> None:
    stop, disk = threading.Event(), SimpleNamespace(free=10**12)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setattr(recorder, "_KNOWN_S", 0.1)
    monkeypatch.setattr(bag, "shutil", SimpleNamespace(disk_usage=lambda _: disk))
    monkeypatch.setattr(record, "stop_event", lambda: nullcontext(stop))
    images = ros.node.create_publisher(Image, TOPIC, QOS_COMMAND)
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(record.record, tmp_path / "bag", topics=(TOPIC,))
        ros.spin_until(images.get_subscription_count, what="the recorder subscribes")
        file = tmp_path / "bag" / "bag.mcap"
        publish_until(images, lambda: file.stat().st_size > 4_000_000)
        if full:
            disk.free = 0
            publish_until(images, done.done)
        else:
            stop.set()
        answer = done.result(DEADLINE_S)
    assert (answer.success, answer.code) == ((False, Code.ENVIRONMENT) if full else (True, Code.OK)), answer.message
    assert ("recording ended early: the disk" in answer.message) == full
    assert answer.data["topics"][TOPIC] >= 3
    assert (answer.data["lost"] > 0) == full
    with bag.open_bag(tmp_path / "bag") as opened:
        assert (opened.mended is not None) == full
        assert all(len(one.data) > NOISE.nbytes for one in opened.records())


def small_files() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (5_000_000, 5_000_000))


@pytest.mark.long
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
    command = [sys.executable, "-m", "openarm_bringup.cli", "record", "bag", "--topics", TOPIC, "--json"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    process = subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True, preexec_fn=limit)
    try:
        ros.spin_until(images.get_subscription_count, what="the recorder subscribes")
        file = tmp_path / "bag" / "bag.mcap"
        publish_until(images, lambda: process.poll() is not None or bool(ending and file.stat().st_size > 4_000_000))
        if ending:
            process.send_signal(ending)
        out, _ = process.communicate(timeout=60.0)
        assert process.returncode == exit_code
    finally:
        process.kill()
        process.communicate()
    if ending != signal.SIGKILL:
        answer = json.loads(out)
        assert answer["success"] == (exit_code == 0), answer["message"]
        assert ("File too large" in answer["message"]) == (ending is None)
    with bag.open_bag(tmp_path / "bag") as opened:
        assert (opened.mended is None) == (ending == signal.SIGINT)
        assert opened.counts[TOPIC] >= 3
        assert all(len(one.data) > NOISE.nbytes for one in opened.records())


HEAR = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("hears")
node.create_subscription(String, "words", lambda _: print(flush=True), 10)
rclpy.spin(node)
"""
SAY = """
import rclpy
from std_msgs.msg import String
rclpy.init()
node = rclpy.create_node("says")
words = node.create_publisher(String, "words", 10)
node.create_timer(0.01, lambda: words.publish(String()))
rclpy.spin(node)
"""


@pytest.fixture
def killed_subscribers(ros) -> None:
    """Two that were killed, and whose publisher, before it was killed too, had opened their ports for 512 messages."""
    domain = int(os.environ["ROS_DOMAIN_ID"])
    with ExitStack() as stack:
        processes: list[subprocess.Popen[bytes]] = []
        for program in (HEAR, HEAR, SAY):
            process = subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE)
            processes.append(stack.enter_context(process))
            stack.callback(process.kill)
        *hear, _ = processes
        for process in hear:
            assert process.stdout.readline(), "a word was heard"
        for process in hear:
            process.kill()

        def opened_again() -> int:
            return sum(not (SHM / f"{name}_el").exists() for name in names_of(domain))

        ros.spin_until(lambda: opened_again() == 2, what="the publisher has opened their ports again")


@pytest.mark.long
@pytest.mark.usefixtures("killed_subscribers")
def test_what_comes_while_the_recorder_is_held_up_is_not_lost(tmp_path: Path) -> None:
    """As on a busy machine: a second of a graph, twice what Fast DDS keeps for a process by itself."""
    command = [sys.executable, "-m", "openarm_bringup.cli", "record", "bag", "--topics", "/stream_.*", "--json"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    spec = NodeSpec(module="bridge", large_messages=True, segment_mib=8)
    profile = {PROFILE: str(write_profile(spec, tmp_path / "fastdds.xml"))}
    pipes: dict[str, Any] = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with (
        subprocess.Popen([sys.executable, streams.__file__], env={**env, **profile}, **pipes) as sender,
        subprocess.Popen(command, cwd=tmp_path, env=env, stdout=subprocess.PIPE, text=True) as recorder,
    ):
        try:
            assert sender.stdout.readline() == "met\n"
            recorder.send_signal(signal.SIGSTOP)
            print(file=sender.stdin, flush=True)
            assert sender.stdout.readline() == "sent\n"
            recorder.send_signal(signal.SIGCONT)
            print(file=sender.stdin, flush=True)
            assert sender.stdout.readline() == "taken\n"
            recorder.send_signal(signal.SIGINT)
            out, _ = recorder.communicate(timeout=60.0)
        finally:
            recorder.kill()
            sender.kill()
    report = json.loads(out)
    sent = streams.STREAMS * streams.ROUNDS + 2
    assert (report["messages"], report["lost"]) == (sent, 0), report["message"]
