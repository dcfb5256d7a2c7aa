# SPDX-License-Identifier: Apache-2.0
"""Nodes that are forked: processes like any other, whose end the supervisor learns of, with or without the server."""

from __future__ import annotations

import os
import signal
import textwrap
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest

from openarm_bringup.supervision import process
from openarm_bringup.supervision.graph import NodeSpec, Ready, Restart
from openarm_bringup.supervision.keeper import NodeState
from tests.conftest import DEADLINE_S
from tests.openarm_bringup.test_supervisor import Running, gone, in_loop, running

pytestmark = pytest.mark.usefixtures("own_state")

#: A module of a node: it says what it is started with, and that it is ready; then it does what OPENARM_TOY says.
TOY = """
    import os, pathlib, sys, time
    FOLDER = pathlib.Path(__file__).parent
    IMPORTED_BY, PREPARED_BY = os.getpid(), []

    def prepare():
        PREPARED_BY.append(os.getpid())

    def main():
        name = next(arg.partition(":=")[2] for arg in sys.argv if arg.startswith("__node:="))
        same = IMPORTED_BY == os.getpid()
        print(name, "imported here" if same else "forked", len(PREPARED_BY), os.environ["OPENARM_TOY"], flush=True)
        print("stdin", repr(sys.stdin.read()), file=sys.stderr, flush=True)
        (FOLDER / name).write_text(str(os.getpid()))
        exec(os.environ["OPENARM_TOY"])

    if __name__ == "__main__":
        main()
"""


@pytest.fixture
def toys(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, NodeSpec]]:
    """Return what makes nodes of the toy module, by name."""
    (tmp_path / "openarm_toy.py").write_text(textwrap.dedent(TOY))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(tmp_path), *filter(None, [os.environ.get("PYTHONPATH")])]))

    def make(*names: str, does: str = "time.sleep(600)", module: str = "openarm_toy") -> dict[str, NodeSpec]:
        monkeypatch.setenv("OPENARM_TOY", does)
        restart = Restart(backoff=0.05, max=2)
        return {name: NodeSpec(module=module, ready=(Ready(service=f"/{name}"),), restart=restart) for name in names}

    return make


def log(folder: Path, name: str) -> list[str]:
    lines = (folder / "run" / "logs" / f"{name}.log").read_text().splitlines()
    return [line.split(" ", 2)[2] for line in lines]


def server(run: Running) -> psutil.Process:
    assert run.supervisor._fork_server is not None
    return psutil.Process(run.supervisor._fork_server.process.pid)


@in_loop
async def test_nodes_are_processes_of_their_own(tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]]) -> None:
    async with running(tmp_path, toys("left", "right")) as run:
        await run.supervisor.wait_ready()
        pids = {name: run.supervisor.pid(name) for name in ("left", "right")}
        for name, pid in pids.items():
            node = psutil.Process(pid)
            assert node.ppid() == os.getpid(), "the supervisor learns of its end by itself"
            assert os.getsid(pid) == os.getpgid(pid) == pid, "signals of the terminal do not reach it"
            assert node.name() == name
            assert log(tmp_path, name) == [f"{name} forked 1 time.sleep(600)", "stdin ''"]
        forks = server(run).pid
    assert [gone(pid) for pid in (*pids.values(), forks)] == [True] * 3
    assert {event.detail for event in run.events if event.state == NodeState.STOPPED} == {"code 1"}


@in_loop
async def test_a_node_that_is_killed_is_forked_again(tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]]) -> None:
    async with running(tmp_path, toys("arm")) as run:
        await run.supervisor.wait_ready()
        first = run.supervisor.pid("arm")
        os.kill(first, signal.SIGKILL)
        await run.until(lambda: run.seen("arm").count(NodeState.READY) == 2)
        assert run.supervisor.pid("arm") != first
        assert any("ended by signal 9" in event.detail for event in run.events)
        assert log(tmp_path, "arm")[2].startswith("arm forked")


@in_loop
async def test_what_a_killed_node_had_started_leaves_no_zombie(
    tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]], monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "child"

    def ended(group: int) -> bool:
        """Its last process ends while it is looked for."""
        child = psutil.Process(int(file.read_text()))
        if child.is_running() and os.getpgid(child.pid) == group:
            child.kill()
            deadline = time.monotonic() + DEADLINE_S
            while child.status() != psutil.STATUS_ZOMBIE:
                assert time.monotonic() < deadline
        return False

    start = f"pathlib.Path({str(file)!r}).write_text(str(__import__('subprocess').Popen(['sleep', '600']).pid))"
    async with running(tmp_path, toys("arm", does=f"{start}; time.sleep(600)")) as run:
        await run.supervisor.wait_ready()
        await run.until(lambda: file.is_file() and file.read_text() != "")
        child = psutil.Process(int(file.read_text()))
        monkeypatch.setattr(process, "group_alive", ended)
        os.kill(run.supervisor.pid("arm"), signal.SIGKILL)
        await run.until(lambda: NodeState.BACKOFF in run.seen("arm"))
        monkeypatch.undo()
        assert not child.is_running()


@in_loop
async def test_without_the_server_nodes_go_on_and_start_as_any_command(
    tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]]
) -> None:
    async with running(tmp_path, toys("left", "right")) as run:
        await run.supervisor.wait_ready()
        left, right = run.supervisor.pid("left"), run.supervisor.pid("right")
        server(run).kill()
        os.kill(left, signal.SIGKILL)
        await run.until(lambda: run.seen("left").count(NodeState.READY) == 2)
        assert run.supervisor.pid("right") == right
        assert not gone(right)
        assert log(tmp_path, "left")[2].startswith("left imported here 0")


@pytest.mark.parametrize(
    ("does", "module", "words"),
    [
        ("sys.exit(3)", "openarm_toy", ["ended with code 3"]),
        ("sys.exit('no camera')", "openarm_toy", ["ended with code 1", "no camera"]),
        ("os.abort()", "openarm_toy", ["ended by signal 6"]),
        ("1 / 0", "openarm_toy", ["ended with code 1", "ZeroDivisionError: division by zero"]),
        ("", "openarm_none", ["ended with code 1", "No module named 'openarm_none'"]),
    ],
)
@in_loop
async def test_how_a_node_ended_is_said(
    tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]], does: str, module: str, words: list[str]
) -> None:
    async with running(tmp_path, toys("arm", does=does, module=module)) as run:
        await run.until(lambda: NodeState.FAILED in run.seen("arm"))
    said = "\n".join(event.detail for event in run.events)
    assert all(word in said for word in words), said


@in_loop
async def test_the_end_of_the_main_function_is_the_end_of_the_node(
    tmp_path: Path, toys: Callable[..., dict[str, NodeSpec]]
) -> None:
    async with running(tmp_path, toys("arm", does="time.sleep(0.3)")) as run:
        await run.until(lambda: NodeState.EXITED in run.seen("arm"))
