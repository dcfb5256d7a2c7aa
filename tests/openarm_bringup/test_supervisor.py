# SPDX-License-Identifier: Apache-2.0
"""The supervisor with toy processes and a toy probe: order, restarts, and above all that nothing survives."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import functools
import os
import re
import signal
import socket
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Sequence
from pathlib import Path

import psutil
import pytest

from openarm_bringup.commands.processes import ps
from openarm_bringup.supervision import environment, guard, keeper, runs
from openarm_bringup.supervision.graph import Graph, NodeSpec, Ready, Restart
from openarm_bringup.supervision.keeper import NodeState
from openarm_bringup.supervision.process import Ladder
from openarm_bringup.supervision.supervisor import Event, Supervisor
from openarm_common.errors import Code, OpenArmError
from tests.conftest import DEADLINE_S

pytestmark = pytest.mark.usefixtures("own_state")

#: Touches the file named by the first argument, as a server that has come up.
READY = "import os, pathlib, sys, time; pathlib.Path(sys.argv[1]).write_text(str(os.getpid()));"


class FileProbe:
    """A condition holds when the file of that name exists; its content is the identity of who wrote it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        #: What it says of every node, and how often it was asked for that.
        self.silent_s, self.asked = 0.0, 0

    def _who(self, condition: Ready) -> str:
        path = self.folder / condition.name.strip("/")
        return path.read_text() if path.exists() else ""

    def known(self, conditions: Sequence[Ready]) -> frozenset[str]:
        return frozenset(self._who(condition) for condition in conditions) - {""}

    def unmet(self, conditions: Sequence[Ready], old: frozenset[str]) -> tuple[str, ...]:
        return tuple(str(condition) for condition in conditions if self._who(condition) in {*old, ""})

    def parameters(self, node: str) -> frozenset[str]:
        return frozenset({"speed"})

    def silence(self, node: str) -> float:
        self.asked += 1
        return self.silent_s

    def trouble(self, node: str) -> str:
        return f"{node} is hot" if (self.folder / "hot").exists() else ""

    def emergency_stop(self, seconds: float) -> str:
        (self.folder / "held").touch()
        return "held"

    def close(self) -> None:
        pass


def toy(folder: Path, name: str, body: str = "time.sleep(60)", **fields: object) -> NodeSpec:
    """Return a node that reports ready and then does `body`."""
    return NodeSpec(
        command=("python", "-S", "-c", READY + body, str(folder / name)),
        ready=(Ready(service=f"/{name}"),),
        **fields,  # type: ignore[arg-type]
    )


class Running:
    """A supervisor under test and what it has reported."""

    def __init__(
        self, folder: Path, nodes: dict[str, NodeSpec], ladder: Ladder | None = None, probe: FileProbe | None = None
    ) -> None:
        self.events: list[Event] = []
        self.supervisor = Supervisor(
            Graph(name="toy", nodes=nodes, domain=67),
            folder / "run",
            lambda: probe or FileProbe(folder),
            listener=self.events.append,
            ladder=ladder,
            poll=0.01,
        )

    async def until(self, condition: Callable[[], bool]) -> None:
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"timed out; events: {self.events}"
            await asyncio.sleep(0.01)

    def seen(self, node: str) -> list[NodeState]:
        return [event.state for event in self.events if event.node == node]


def in_loop(test: Callable[..., Awaitable[None]]) -> Callable[..., None]:
    """Make a test of a coroutine."""

    @functools.wraps(test)
    def run(**given: object) -> None:
        asyncio.run(test(**given))  # type: ignore[arg-type]

    return run


@contextlib.asynccontextmanager
async def running(
    folder: Path, nodes: dict[str, NodeSpec], ladder: Ladder | None = None, probe: FileProbe | None = None
) -> AsyncIterator[Running]:
    run = Running(folder, nodes, ladder, probe)
    await run.supervisor.start()
    try:
        yield run
    finally:
        await run.supervisor.stop()


def gone(pid: int) -> bool:
    try:
        return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return True


def wait_gone(pids: Sequence[int]) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not all(gone(pid) for pid in pids):
        assert time.monotonic() < deadline, f"still alive: {[pid for pid in pids if not gone(pid)]}"
        threading.Event().wait(0.05)


@pytest.mark.requirement("B-12")
@in_loop
async def test_nodes_start_when_their_needs_are_ready_and_stop_in_reverse(tmp_path: Path) -> None:
    nodes = {
        "last": toy(tmp_path, "last", needs=("middle",)),
        "middle": toy(tmp_path, "middle", needs=("first",)),
        "first": toy(tmp_path, "first"),
    }

    async with running(tmp_path, nodes) as run:
        await run.supervisor.wait_ready()
        assert all(state == NodeState.READY for state in run.supervisor.states().values())
        (record,) = runs.running()
        assert record.ready
        assert record.domain == 67
    assert runs.running() == []
    events = [(event.node, event.state) for event in run.events]
    starts = [node for node, state in events if state == NodeState.STARTING]
    stops = [node for node, state in events if state == NodeState.STOPPED]
    assert starts == ["first", "middle", "last"]
    assert stops == ["last", "middle", "first"]
    for need, node in (("first", "middle"), ("middle", "last")):
        assert events.index((need, NodeState.READY)) < events.index((node, NodeState.STARTING))


@in_loop
async def test_output_goes_to_a_log_per_node_with_the_time(tmp_path: Path) -> None:
    body = (
        "print('to out', flush=True); print('to err', file=sys.stderr, flush=True);"
        "sys.stdout.write('no end'); sys.stdout.flush(); time.sleep(0.3)"
    )

    async with running(tmp_path, {"talker": toy(tmp_path, "talker", body)}) as run:
        await run.until(lambda: NodeState.EXITED in run.seen("talker"))
    lines = (tmp_path / "run" / "logs" / "talker.log").read_text().splitlines()
    assert [line.split(" ", 2)[2] for line in lines] == ["to out", "to err", "no end"]
    assert all(line[:2] == "20" and line[10] == " " for line in lines)


@pytest.mark.requirement("P-34")
@in_loop
async def test_a_full_run_folder_holds_no_node_up_and_nothing_is_left_after_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    logs = tmp_path / "run" / "logs"
    logs.mkdir(parents=True)
    for name in ("talker", "supervisor"):
        (logs / f"{name}.log").symlink_to("/dev/full")
    much = "print('x' * 300_000, flush=True); pathlib.Path(sys.argv[1] + '.printed').touch(); time.sleep(60)"
    nodes = {"talker": toy(tmp_path, "talker", much, params={"speed": 1.0}, restart=Restart(backoff=0.05))}

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    async with running(tmp_path, nodes) as run:
        await run.supervisor.wait_ready()
        await run.until(lambda: (tmp_path / "talker.printed").exists())
        monkeypatch.setattr(environment, "write_whole", full)
        monkeypatch.setattr(runs, "write_record", full)
        first = run.supervisor.pid("talker")
        os.kill(first, signal.SIGKILL)
        await run.until(lambda: run.seen("talker").count(NodeState.READY) == 2)
        second = run.supervisor.pid("talker")
    assert [gone(pid) for pid in (first, second)] == [True, True]
    assert run.supervisor.lost_lines > 1
    said = [event.detail for event in run.events if event.node == "supervisor"]
    assert [text.partition(":")[0] for text in said] == [f"can't write to {f}" for f in (logs, runs.state_dir())]
    assert runs.running() == []


@in_loop
async def test_a_node_that_was_killed_comes_back_without_its_ports_and_old_endpoints_do_not_count_as_ready(
    tmp_path: Path,
) -> None:
    """Others would go on writing into the shared memory that has the numbers of the ports."""
    take = """
import itertools, socket, time
for port in itertools.count(7400 + 250 * 67 + 10):
    try:
        taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM); taken.bind(("127.0.0.1", port)); break
    except OSError: pass
pathlib.Path(sys.argv[1] + ".port").write_text(str(port))
pathlib.Path(sys.argv[1]).write_text(str(os.getpid()))
time.sleep(60)
"""
    spec = toy(tmp_path, "arm", restart=Restart(backoff=0.05))
    command = ("python", "-S", "-c", f"import os, pathlib, sys{take}", str(tmp_path / "arm"))
    port = tmp_path / "arm.port"
    async with running(tmp_path, {"arm": spec.model_copy(update={"command": command})}) as run:
        await run.supervisor.wait_ready()
        first, killed = int(port.read_text()), run.supervisor.pid("arm")
        os.kill(killed, signal.SIGKILL)
        await run.until(lambda: run.seen("arm").count(NodeState.READY) == 2)
        assert (tmp_path / "arm").read_text() == str(run.supervisor.pid("arm")) != str(killed)
        assert int(port.read_text()) != first
        back = [NodeState.STARTING, NodeState.READY]
        assert run.seen("arm") == [*back, NodeState.BACKOFF, *back]
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as one:
        one.bind(("", first))  # released at the end


@in_loop
async def test_what_a_node_says_is_wrong_is_shown_until_it_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper, "_LOOK_S", 0.01)
    async with running(tmp_path, {"motor": toy(tmp_path, "motor")}, probe=FileProbe(tmp_path)) as run:
        await run.supervisor.wait_ready()
        (tmp_path / "hot").touch()
        await run.until(lambda: runs.running()[0].nodes["motor"].trouble == "motor is hot")
        assert "    motor is hot" in ps(seconds=0.0).text.splitlines()
        (tmp_path / "hot").unlink()
        await run.until(lambda: runs.running()[0].nodes["motor"].trouble == "")
        assert "hot" not in ps(seconds=0.0).text


@pytest.mark.long
@in_loop
async def test_a_node_that_hangs_is_started_again_and_one_that_somebody_has_halted_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(keeper, "_HANGS_S", 0.1)
    monkeypatch.setattr(keeper, "_LOOK_S", 0.01)
    probe = FileProbe(tmp_path)
    async with running(tmp_path, {"toy": toy(tmp_path, "toy")}, probe=probe) as run:
        await run.supervisor.wait_ready()
        pid = run.supervisor.pid("toy")
        os.kill(pid, signal.SIGSTOP)
        probe.silent_s, asked = 20.0, probe.asked
        await run.until(lambda: probe.asked > asked + 50)
        assert run.seen("toy")[-1] is NodeState.READY
        assert run.supervisor.pid("toy") == pid

        os.kill(pid, signal.SIGCONT)
        await run.until(lambda: NodeState.BACKOFF in run.seen("toy"))
        probe.silent_s = 0.0
        assert run.events[-1].detail.startswith("hung: no sign of life for 20 s; restart 1 of 5")
        await run.until(lambda: run.supervisor.states()["toy"] is NodeState.READY)
        assert gone(pid)


@pytest.mark.long
@in_loop
async def test_restarts_end_after_the_maximum_with_the_log_in_the_message(tmp_path: Path) -> None:
    crash = "time.sleep(0.2); print('no camera found', flush=True); sys.exit(3)"
    nodes = {"eye": toy(tmp_path, "eye", crash, restart=Restart(backoff=0.05, max=2))}

    async with running(tmp_path, nodes) as run:
        with pytest.raises(OpenArmError, match=r"(?s)ended with code 3 after 2 restarts.*no camera found") as caught:
            await run.supervisor.wait_stop_asked()
        assert run.seen("eye").count(NodeState.BACKOFF) == 2
        assert run.seen("eye")[-1] == NodeState.FAILED
    assert caught.value.code == Code.NOT_READY


SLEEP = ("python", "-S", "-c", "import time; time.sleep(60)")
BROKEN = ("python", "-c", "raise SystemExit('no such scene')")


@pytest.mark.parametrize(
    ("node", "words"),
    [
        (
            {"command": SLEEP, "ready": (Ready(action="/pick"),), "ready_timeout": 0.5},
            "arm was not ready after 0.5 s; missing: action /pick",
        ),
        ({"command": BROKEN, "ready": (Ready(service="/x"),)}, "no such scene"),
        ({"command": BROKEN, "ready": (Ready(service="/x"),), "essential": False}, "no such scene"),
        ({"params": {"sped": 1}}, "no parameter of arm 'sped'; did you mean speed?"),
    ],
    ids=["never ready", "fails at its first start", "could be spared", "unknown parameter, which ROS would ignore"],
)
@in_loop
async def test_a_node_that_does_not_come_up_fails_the_graph(
    tmp_path: Path, node: dict[str, object], words: str
) -> None:
    nodes = {"arm": toy(tmp_path, "arm").model_copy(update=node)}
    async with running(tmp_path, nodes) as run:
        with pytest.raises(OpenArmError, match=re.escape(words)):
            await run.supervisor.wait_ready()


@in_loop
async def test_error_inside_the_probe_is_raised_and_not_waited_for_ever(tmp_path: Path) -> None:
    def no_rclpy() -> FileProbe:
        raise ImportError("no rclpy here")

    supervisor = Supervisor(Graph(name="toy", nodes={"arm": toy(tmp_path, "arm")}), tmp_path / "run", no_rclpy)
    await supervisor.start()
    try:
        with pytest.raises(ImportError, match="no rclpy here"):
            await supervisor.wait_ready()
    finally:
        await supervisor.stop()


@pytest.mark.requirement("P-34")
@in_loop
async def test_grandchildren_end_with_their_node(tmp_path: Path) -> None:
    body = (
        "import subprocess; subprocess.Popen([sys.executable, '-S', '-c', 'import os, pathlib, signal, sys, time;"
        " signal.signal(2, signal.SIG_IGN); signal.signal(15, signal.SIG_IGN);"
        " pathlib.Path(sys.argv[1]).write_text(str(os.getpid())); time.sleep(60)', sys.argv[1] + '.child']);"
        " time.sleep(60)"
    )

    async with running(tmp_path, {"parent": toy(tmp_path, "parent", body)}, Ladder(0.1, 0.1)) as run:
        await run.supervisor.wait_ready()
        child = tmp_path / "parent.child"
        await run.until(lambda: child.exists() and child.read_text() != "")
        pids = [run.supervisor.pid("parent"), int(child.read_text())]
    wait_gone(pids)


DEAF_TO_INT = "import signal; signal.signal(2, signal.SIG_IGN); print('deaf', flush=True); time.sleep(60)"
STUBBORN = "import signal; signal.signal(15, signal.SIG_IGN);" + DEAF_TO_INT


@pytest.mark.parametrize(
    ("body", "ladder", "detail"),
    [
        ("time.sleep(60)", Ladder(60.0, 60.0), "code -2"),
        (DEAF_TO_INT, Ladder(0.1, 60.0), "code -15"),
        (STUBBORN, Ladder(0.1, 0.1), "killed (-9)"),
    ],
)
@in_loop
async def test_stop_goes_up_the_ladder_int_term_kill(tmp_path: Path, body: str, ladder: Ladder, detail: str) -> None:
    async with running(tmp_path, {"toy": toy(tmp_path, "toy", body)}, ladder) as run:
        await run.supervisor.wait_ready()
        if body != "time.sleep(60)":
            log = tmp_path / "run" / "logs" / "toy.log"
            await run.until(lambda: log.exists() and "deaf" in log.read_text())
    assert run.events[-1].detail.startswith(detail)


@in_loop
async def test_the_probe_leaves_while_the_nodes_are_still_there(tmp_path: Path) -> None:
    """Fast DDS may hold a participant for ever whose peers have just gone."""
    closed: list[tuple[str, bool]] = []

    class Leaving(FileProbe):
        def close(self) -> None:
            closed.extend((name, not gone(run.supervisor.pid(name))) for name in run.supervisor.states())

    async with running(tmp_path, {name: toy(tmp_path, name) for name in "ab"}, probe=Leaving(tmp_path)) as run:
        await run.supervisor.wait_ready()
    assert closed == [("a", True), ("b", True)]


@in_loop
async def test_second_ctrl_c_is_the_emergency_stop_and_cuts_the_patience_short(tmp_path: Path) -> None:
    run = Running(tmp_path, {"deaf": toy(tmp_path, "deaf", STUBBORN)}, Ladder(600.0, 600.0))
    await run.supervisor.start()
    await run.supervisor.wait_ready()
    log = tmp_path / "run" / "logs" / "deaf.log"
    await run.until(lambda: log.exists() and "deaf" in log.read_text())
    run.supervisor.ask_stop()
    stopping = asyncio.create_task(run.supervisor.stop())
    await asyncio.sleep(0.3)
    assert not (tmp_path / "held").exists(), "the first only ends the graph"
    run.supervisor.ask_stop()
    await run.until((tmp_path / "held").exists)  # the second is the emergency stop
    async with asyncio.timeout(DEADLINE_S):
        while not stopping.done():
            run.supervisor.ask_stop()
            await asyncio.sleep(0.1)
    await stopping


def test_the_guard_goes_up_its_ladder(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(guard, "LADDER", ((signal.SIGINT, 0.1), (signal.SIGTERM, 0.1), (signal.SIGKILL, DEADLINE_S)))
    node = subprocess.Popen(
        [sys.executable, "-S", "-c", f"import time; {STUBBORN}"], stdout=subprocess.PIPE, start_new_session=True
    )
    assert node.stdout.readline() == b"deaf\n"
    guard.end({node.pid})
    node.communicate()
    assert node.returncode == -signal.SIGKILL


@pytest.mark.long
@pytest.mark.parametrize("body", ["time.sleep(60)", DEAF_TO_INT])
@pytest.mark.requirement("P-34")
def test_children_end_when_the_supervisor_is_killed(tmp_path: Path, body: str) -> None:
    """SIGKILL leaves the supervisor no time for anything: its guard ends the nodes."""
    script = tmp_path / "supervise.py"
    script.write_text(
        textwrap.dedent(
            f"""
            import asyncio, sys
            from pathlib import Path
            sys.path.insert(0, {str(Path(__file__).parent)!r})
            import test_supervisor as t
            folder = Path({str(tmp_path)!r})
            async def main():
                nodes = {{name: t.toy(folder, name, {body!r}) for name in "ab"}}
                run = t.Running(folder, nodes)
                await run.supervisor.start()
                await run.supervisor.wait_ready()
                print("up", *(run.supervisor.pid(n) for n in nodes), flush=True)
                await run.supervisor.wait_stop_asked()
            asyncio.run(main())
            """
        )
    )
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    process = subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True, env=env)
    try:
        word, *pids = process.stdout.readline().split()
        assert word == "up"
        assert len(pids) == 2
    finally:
        process.kill()
        process.communicate()
    wait_gone([int(pid) for pid in pids])
    assert runs.running() == [], "a dead supervisor's record must not be listed"
