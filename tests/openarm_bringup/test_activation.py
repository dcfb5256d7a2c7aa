# SPDX-License-Identifier: Apache-2.0
"""The supervisor starts the daemon when a command asks, and nothing that happens to it hurts the graph."""

from __future__ import annotations

import asyncio
import os
import signal
import textwrap
from pathlib import Path

import pytest

from openarm_bringup.supervision import activation
from openarm_bringup.supervision.keeper import NodeState
from openarm_bringup.supervision.state import is_private, socket_path, state_dir
from tests.openarm_bringup.test_supervisor import in_loop, running, toy, wait_gone

pytestmark = pytest.mark.requirement("R-26")
#: Says its process number to each client; ends after "end", without a fault.
TOY = """
    import os, socket, sys
    listener = socket.socket(fileno=int(sys.argv[1]))
    listener.setblocking(True)
    while True:
        connection, _ = listener.accept()
        connection.sendall(b"%d\\n" % os.getpid())
        if connection.recv(100) == b"end":
            sys.exit()
        connection.close()
"""


@pytest.fixture(autouse=True)
def toy_daemon(own_state: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "toy_daemon.py").write_text(textwrap.dedent(TOY))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(activation, "_MODULE", "toy_daemon")
    monkeypatch.setattr(activation, "_PAUSE_S", 0.01)


async def greeting(say: bytes = b"") -> bytes:
    """Connect, and return the first line of the daemon; nothing when the client is turned away."""
    reader, writer = await asyncio.open_unix_connection(str(socket_path(os.getpid())))
    line = await asyncio.wait_for(reader.readline(), 30.0)
    writer.write(say)
    writer.close()
    return line


@in_loop
async def test_the_daemon_starts_when_it_is_asked_and_again_when_it_has_ended(tmp_path: Path) -> None:
    async with running(tmp_path, {"arm": toy(tmp_path, "arm")}) as run:
        await run.supervisor.wait_ready()
        assert is_private(socket_path(os.getpid()))
        assert run.supervisor.daemon._process is None, "nobody has asked yet"
        first = int(await greeting())
        assert int(await greeting(b"end")) == first
        second = int(await greeting())  # it waits for the next, which is not of the same code
        assert second != first
        os.kill(second, signal.SIGKILL)
        await run.until(lambda: "the daemon ended (-9)" in (tmp_path / "run/logs/supervisor.log").read_text())
        while not (line := await greeting()):
            pass  # turned away while the dead one was tidied up
        assert run.supervisor.states() == {"arm": NodeState.READY}
    pids = [first, second, int(line)]
    wait_gone(pids)
    assert len(set(pids)) == 3
    assert not socket_path(os.getpid()).exists()


@in_loop
async def test_where_the_daemon_cannot_start_clients_are_turned_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(activation, "_MODULE", "no_such_module")
    async with running(tmp_path, {"arm": toy(tmp_path, "arm")}) as run:
        await run.supervisor.wait_ready()
        assert await greeting() == b""
        assert await greeting() == b""
        assert run.supervisor.states() == {"arm": NodeState.READY}
    assert "No module named no_such_module" in (tmp_path / "run/logs/daemon.log").read_text()


@in_loop
async def test_in_a_folder_that_others_can_open_there_is_no_socket(tmp_path: Path) -> None:
    state_dir().mkdir()
    state_dir().chmod(0o755)
    async with running(tmp_path, {"arm": toy(tmp_path, "arm")}) as run:
        await run.supervisor.wait_ready()
        assert not socket_path(os.getpid()).exists()
    assert "is not this user's alone" in (tmp_path / "run/logs/supervisor.log").read_text()
