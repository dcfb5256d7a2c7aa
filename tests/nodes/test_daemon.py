# SPDX-License-Identifier: Apache-2.0
"""The daemon of a graph: it answers as the command line does by itself, and nothing that comes hurts it."""

from __future__ import annotations

import json
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from openarm_interfaces.srv import SetPause
from std_msgs.msg import String

from openarm_bringup import cli
from openarm_bringup.commands import connect
from openarm_bringup.daemon import client, protocol, server
from openarm_bringup.ros.peer import Peer
from openarm_bringup.supervision import runs
from openarm_bringup.supervision.state import socket_path
from openarm_common.domain import release_domain, reserve_domain
from openarm_common.ros.client import BackgroundNode, new_context
from openarm_common.ros.node import QOS_COMMAND, QOS_LATCHED
from tests.openarm_bringup.commands import record_of

pytestmark = pytest.mark.requirement("R-26")
ROOT = Path(__file__).parents[2]
#: At once with other tests the start of a process can take that long, s.
DEADLINE = 60.0


class Graph:
    """A node that offers one of each kind, and a daemon next to it."""

    def __init__(self, domain: int, run_dir: Path) -> None:
        self.domain = domain
        self._peer = BackgroundNode("probe", domain=domain)
        # Knows the graph for as long as it has a node; that takes seconds, as the start of the daemon does.
        self.context = new_context(domain)
        self._resident = Peer(self.context)
        node = self._peer._node
        node.declare_parameter("height", 0.5)
        node.create_publisher(String, "/status", QOS_LATCHED).publish(String(data="ready"))
        self.ticks = node.create_publisher(String, "/ticks", QOS_COMMAND)
        self.silent = node.create_publisher(String, "/silent", QOS_COMMAND)
        node.create_timer(0.02, lambda: self.ticks.publish(String(data="tick")))
        node.create_service(SetPause, "/pause", self._pause)
        ready = runs.NodeRecord(state="ready")
        runs.write_record(record_of("toy", domain, {"probe": ready}, run_dir=str(run_dir), ready=True))
        path = socket_path(os.getpid())
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        self.listener.bind(str(path))
        path.chmod(0o600)
        self.listener.listen(32)
        self.env = {**os.environ, "PYTHONPATH": str(ROOT)}
        fd = self.listener.fileno()
        # as in the background of a shell, where SIGINT is ignored
        command = ["sh", "-c", "trap '' INT; exec \"$@\"", "sh", sys.executable, "-m", "openarm_bringup.daemon"]
        self.daemon = subprocess.Popen([*command, str(fd), str(self.domain)], env=self.env, pass_fds=(fd,))

    def close(self) -> None:
        self.daemon.send_signal(signal.SIGINT)
        self.listener.close()
        try:
            assert self.daemon.wait(DEADLINE) == 0
        finally:
            self.daemon.kill()
            self._resident.close()
            self.context.try_shutdown()
            self._peer.close()

    def connect(self) -> socket.socket:
        """Connect as a client, and hear the greeting."""
        connection = socket.socket(socket.AF_UNIX)
        connection.settimeout(DEADLINE)
        connection.connect(str(socket_path(os.getpid())))
        assert json.loads(client._line(connection))["domain"] == self.domain
        return connection

    def start(self, *words: str) -> subprocess.Popen[str]:
        """Start a command that goes on."""
        command = [sys.executable, "-m", "openarm_bringup.cli", *words]
        return subprocess.Popen(command, env=self.env, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Wait while the node spins."""
        waited, deadline = threading.Event(), time.monotonic() + DEADLINE
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"not within {DEADLINE:g} s: {what}")
            waited.wait(0.02)

    def _pause(self, request: SetPause.Request, response: SetPause.Response) -> SetPause.Response:
        response.success, response.message = request.paused, "paused" if request.paused else "only true is taken"
        return response


@pytest.fixture(scope="module")
def graph(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Graph]:
    domain, folder = reserve_domain(), tmp_path_factory.mktemp("graph")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        patch.setenv("XDG_RUNTIME_DIR", str(folder))
        patch.setattr(client, "_GREETING_S", DEADLINE)  # the daemon is being started
        graph = Graph(domain, folder)
        graph.connect().close()
        yield graph
        graph.close()
    release_domain(domain)


LINES = (
    "topic list",
    "topic echo /status -n 1 --json",
    "service call /pause {paused:\xa0false}",
    "topic frobnicate",
    "topic type ticks",
    "topic info /ticks",
    "topic echo /statsu",
    "service list --json",
    "service type /pause",
    "service call /pause {paused:\xa0true}",
    "service call /pause {pause:\xa0true}",
    "node list",
    "node info probe",
    "action list",
    "param list probe",
    "param get probe height",
    "param set probe height 0.5",
    "param dump probe",
    "param get prob height",
    "topic echo",
)
SLOW = ("topic echo /status -n 1", "tf echo world base")


@pytest.mark.long
@pytest.mark.parametrize("lines", [LINES, SLOW], ids=["quick", "slow"])
def test_both_ways_give_the_same_answer(
    graph: Graph, capsys: pytest.CaptureFixture[str], lines: tuple[str, ...]
) -> None:
    for number, line in enumerate(lines):
        words = [word.replace("\xa0", " ") for word in line.split(" ")]
        asked = client.ask(words)
        by_daemon = capsys.readouterr()
        assert asked is not None, line
        # Discovery takes seconds: most commands of this process share one.
        before = connect.PEER.set(partial(Peer, graph.context, settled=True) if number else None)
        assert (asked, by_daemon) == (cli.run(words), capsys.readouterr()), line
        connect.PEER.reset(before)
    assert graph.daemon.poll() is None


def test_ctrl_c_and_the_end_of_a_client_end_what_it_asked_for(graph: Graph) -> None:
    for number, code in ((signal.SIGINT, 0), (signal.SIGKILL, -signal.SIGKILL)):
        echo = graph.start("topic", "echo", "/ticks")
        assert echo.stdout.readline() == "{data: tick}\n"
        assert graph.ticks.get_subscription_count() == 1
        echo.send_signal(number)
        assert echo.wait(DEADLINE) == code
        graph.wait(lambda: graph.ticks.get_subscription_count() == 0, "the subscription ends")
        echo.communicate()


def test_a_request_that_waits_holds_up_no_other(graph: Graph, capsys: pytest.CaptureFixture[str]) -> None:
    waiting = [graph.connect() for _ in range(6)]
    for connection in waiting:
        protocol.send(connection, ["topic", "echo", "/silent", "--timeout", "600"])
    graph.wait(lambda: graph.silent.get_subscription_count() == len(waiting), "all wait")
    assert client.ask(["topic", "type", "/ticks"]) == 0
    for connection in waiting:
        connection.close()
    graph.wait(lambda: graph.silent.get_subscription_count() == 0, "none waits")


def test_garbage_is_closed_and_hurts_nothing(graph: Graph, capsys: pytest.CaptureFixture[str]) -> None:
    chance = random.Random(5)
    words = ["topic", "list", "up", "sim", "--json", "x.json", "tf", "\0", "\x1b[2J", "-n", "💥", "ps"]
    nested: Any = []
    for _ in range(200):
        nested = [nested]
    inputs = [b"\n", b"{}\n", b"[]\n", b"null\n", b"[" * 50_000 + b"\n", json.dumps(nested).encode() + b"\n"]
    inputs += [b"x" * (protocol.LONGEST + 1), b"[1]\n", b'["up"]\n', b'["topic", 3]\n', b'["tf","tree","--out","/x"]\n']
    inputs += [chance.randbytes(chance.randrange(1, 300)) + b"\n" for _ in range(60)]
    for _ in range(40):
        line = bytearray(json.dumps([chance.choice(words) for _ in range(chance.randrange(1, 6))]).encode())
        for _ in range(chance.randrange(3)):
            line[chance.randrange(len(line))] = chance.randrange(256)
        inputs.append(bytes(line) + b"\n")
    before = {thread.id for thread in psutil.Process(graph.daemon.pid).threads()}
    for given in inputs:
        with graph.connect() as connection:
            try:
                connection.sendall(given)
                connection.shutdown(socket.SHUT_WR)  # a command that has come about in spite of all is ended
                while connection.recv(1 << 16):
                    pass
            except ConnectionError:
                pass  # refused before it was read to the end
    assert graph.daemon.poll() is None
    graph.wait(
        lambda: {thread.id for thread in psutil.Process(graph.daemon.pid).threads()} <= before, "its threads have ended"
    )
    assert client.ask(["topic", "type", "/ticks"]) == 0
    assert capsys.readouterr().out.endswith("std_msgs/msg/String\n")


def test_a_user_who_is_another_is_told_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    here, there = socket.socketpair()
    daemon = server.Daemon.__new__(server.Daemon)
    daemon._greeting = {"build": "", "domain": 0}
    monkeypatch.setattr(server, "peer_uid", lambda _: os.geteuid() + 1)
    daemon._serve(here)
    assert there.recv(100) == b""
    there.close()
