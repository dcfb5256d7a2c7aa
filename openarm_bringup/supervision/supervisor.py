# SPDX-License-Identifier: Apache-2.0
"""Starts the nodes of a graph in the order of their needs, watches them, and stops every one of them.

All of it runs in one asyncio loop; the ROS graph is asked through a `Probe` in a thread. A node that fails is started
again, with growing pauses while it does not get ready. Stopping goes from the last dependents to the first needs;
nothing survives it. Should the supervisor itself be killed, a guard process ends the nodes.
"""

from __future__ import annotations

import asyncio
import os
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import psutil

from openarm_bringup.supervision import environment, guard, runs, shm
from openarm_bringup.supervision.activation import Activation
from openarm_bringup.supervision.forking import ForkServer
from openarm_bringup.supervision.graph import Graph
from openarm_bringup.supervision.keeper import Keeper, NodeState, Probe
from openarm_bringup.supervision.log import LogFile
from openarm_bringup.supervision.process import Ladder, Start, command
from openarm_common.errors import Code, OpenArmError
from openarm_common.ports import HeldPorts
from openarm_common.robot.folder import robot_name

T = TypeVar("T")

#: Longest wait for the answer of the emergency stop before the end is hurried, s.
_STOP_S = 0.5


@dataclass(frozen=True)
class Event:
    """A change of the state of a node."""

    seconds: float
    node: str
    state: NodeState
    detail: str


class Supervisor:
    """Runs one graph; made inside a running asyncio loop.

    Args:
        graph: Graph to run.
        run_dir: Gets `logs/<node>.log`, `logs/supervisor.log` and `params/`.
        probe: Makes the probe; called in a thread, because it imports rclpy.
        listener: Is called with every change of state.
        ladder: Longest waits for nodes to end.
        poll: Period at which a node that is not ready is checked, s.
    """

    def __init__(
        self,
        graph: Graph,
        run_dir: Path,
        probe: Callable[[], Probe],
        *,
        listener: Callable[[Event], None] | None = None,
        ladder: Ladder | None = None,
        poll: float = 0.1,
    ) -> None:
        self.graph = shm.with_larger_segments(graph)
        self.run_dir = run_dir
        self._make_probe = probe
        self._probe: asyncio.Future[Probe] | None = None
        self._listener = listener
        self._began = time.monotonic()
        self._started = datetime.now().isoformat(timespec="seconds")
        self._trouble: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._threads = ThreadPoolExecutor(max_workers=1, thread_name_prefix="probe")
        self._watchers: list[asyncio.Task[None]] = []
        self._guard: asyncio.subprocess.Process | None = None
        self._fork_server: ForkServer | None = None
        self.spawning = asyncio.Lock()
        self.stop_asked = asyncio.Event()
        self._hurrying: asyncio.Task[None] | None = None
        self.ladder, self.poll = ladder or Ladder(), poll
        self._logs: list[LogFile] = []
        self._log = self.log_file("supervisor")
        self._disk_faults: set[Path] = set()
        #: What was in /dev/shm at the end.
        self.left: set[str] = set()
        self.ports = HeldPorts()
        self._keepers = {name: Keeper(name, self) for name in self.graph.nodes}
        self.daemon = Activation(self)

    async def start(self) -> None:
        """Begin to start the nodes; returns at once.

        Raises:
            OpenArmError: BUSY, when a node of the graph runs in its domain already; ENVIRONMENT, when /dev/shm is too
                small for it.
        """
        self.say(f"graph {self.graph.name} of robot {robot_name()}")
        runs.refuse_twins(environment.domain_id(self.graph), self.graph.nodes)
        shm.check_shm(self.graph)
        (self.run_dir / "logs").mkdir(parents=True, exist_ok=True)
        self._guard = await asyncio.create_subprocess_exec(
            sys.executable,
            "-I",
            "-S",
            guard.__file__,
            *(sys.executable, "-m", shm.__name__, str(environment.domain_id(self.graph))),
            stdin=asyncio.subprocess.PIPE,
            start_new_session=True,
        )
        await self._open_fork_server()
        self._open_probe()
        for keeper in self._keepers.values():
            watcher = asyncio.create_task(keeper.keep([self._keepers[need] for need in keeper.spec.needs]))
            watcher.add_done_callback(lambda task, keeper=keeper: self._watcher_ended(keeper, task))
            self._watchers.append(watcher)
        self.daemon.open()
        self.record()

    async def wait_ready(self) -> float:
        """Wait until every node is ready; return how long that took since the supervisor was made, s.

        Raises:
            OpenArmError: what kept a node from it (with the end of its log); CANCELLED when asked to stop meanwhile.
        """
        ready = asyncio.create_task(self._all_ready())
        try:
            await self.wait_stop_asked(ready)
            if not ready.done():
                raise OpenArmError(Code.CANCELLED, "asked to stop before the graph was ready")
        finally:
            ready.cancel()
        self.record()
        return time.monotonic() - self._began

    async def wait_stop_asked(self, *others: asyncio.Task[None]) -> None:
        """Wait for `ask_stop`, the end of another task, or until a node was given up.

        Raises:
            OpenArmError: why a node was given up that the graph can't do without.
        """
        stopping = asyncio.create_task(self.stop_asked.wait())
        await asyncio.wait([stopping, self._trouble, *others], return_when=asyncio.FIRST_COMPLETED)
        stopping.cancel()
        if self._trouble.done():
            self._trouble.result()

    def ask_stop(self) -> None:
        """Ask for the end; a second time: emergency stop, and hurry (the next signal at once); then hurry on."""
        if self._hurrying is not None and self._hurrying.done():
            self.ladder.hurry()
        elif self._hurrying is None and self.stop_asked.is_set():
            self._hurrying = asyncio.create_task(self._hold_and_hurry())
        self.stop_asked.set()

    async def _hold_and_hurry(self) -> None:
        try:
            async with asyncio.timeout(3.0 * _STOP_S):
                if self._probe is None:  # closed by `stop`; this one stays until the process ends
                    self._open_probe()
                self.say(f"emergency stop: {await self.ask(lambda probe: probe.emergency_stop(_STOP_S))}")
        except (TimeoutError, OpenArmError, RuntimeError) as error:  # the last: everything has ended meanwhile
            self.say(f"no emergency stop: {error!r}")
        self.ladder.hurry()

    async def stop(self, *, ends: bool = False) -> None:
        """Stop every node, dependents before their needs, and leave nothing behind.

        Args:
            ends: So does this process, by `shm.leave` with the names in `left`. Otherwise the probe leaves before the
                nodes do: Fast DDS may not let a participant go whose peers have just gone, as `shm.leave` says.
        """
        self.stop_asked.set()
        await self.daemon.close()
        async with self.spawning:  # a process that is being started is known before its watcher is cancelled
            for watcher in self._watchers:
                watcher.cancel()
        await asyncio.gather(*self._watchers, return_exceptions=True)
        mapped = shm.mapped_by(os.getpid())
        stops: list[asyncio.Task[None]] = []
        if not ends:
            stops.append(asyncio.create_task(self._close_probe()))
            await asyncio.wait(stops, timeout=1.0)
        for level in reversed(self.graph.levels()):
            tasks = [asyncio.create_task(self._keepers[name].stop()) for name in level]
            stops += tasks
            # A node that is slow to end does not hold back the rest: its own ladder goes on meanwhile.
            await asyncio.wait(tasks, timeout=1.0)
        await asyncio.gather(*stops)
        if self._fork_server is not None:
            await self._fork_server.close()
        self.ports.close()
        mapped |= shm.mapped_by(os.getpid())
        self._threads.shutdown()
        mapped |= self.daemon.mapped.union(*(keeper.mapped for keeper in self._keepers.values()))
        domain = environment.domain_id(self.graph)
        self.left = {*mapped, *shm.names_of(domain), *shm.unborn()}
        swept = await asyncio.to_thread(shm.sweep, self.left)
        self.say(f"removed from /dev/shm: {', '.join(swept) or 'nothing'}")
        await self._dismiss_guard()
        runs.remove_record(os.getpid())

    def states(self) -> dict[str, NodeState]:
        """Return the state of every node."""
        return {name: keeper.state for name, keeper in self._keepers.items()}

    def pid(self, node: str) -> int:
        """Return the process id of a running node.

        Raises:
            OpenArmError: NOT_READY, when it does not run.
        """
        pid = self._keepers[node].pid
        if pid is None:
            raise OpenArmError(Code.NOT_READY, f"{node} is not running; it is {self._keepers[node].state}")
        return pid

    async def _open_fork_server(self) -> None:
        if not all(spec.foreign for spec in self.graph.nodes.values()):
            env = environment.client_environment(self.graph, self.run_dir)
            self._fork_server = await ForkServer.open(env, self.log_file("fork_server"))
            self.tell_guard(f"+{self._fork_server.process.pid}")

    def starting(self, name: str) -> Start:
        """Return what starts the process of a node; writes its parameters and its Fast DDS profile."""
        argv = environment.node_arguments(self.graph, name, self.run_dir)
        env = environment.node_environment(self.graph, name, self.run_dir)
        if self._fork_server is None or self.graph.nodes[name].foreign:
            return command(argv, env)
        return self._fork_server.node(name, argv, env)

    def _watcher_ended(self, keeper: Keeper, task: asyncio.Task[None]) -> None:
        error = None if task.cancelled() else task.exception()
        if error is None:
            return
        keeper.state = NodeState.FAILED
        text = error.message if isinstance(error, OpenArmError) else repr(error)
        goes_on = keeper.dispensable and isinstance(error, OpenArmError)
        self.changed(keeper.name, NodeState.FAILED, f"the graph goes on without it: {text}" if goes_on else text)
        if not goes_on and not self._trouble.done():
            self._trouble.set_exception(error)
            self._trouble.exception()  # marked as retrieved: it may not be awaited

    async def _all_ready(self) -> None:
        for keeper in self._keepers.values():
            await keeper.ready.wait()

    def _open_probe(self) -> None:
        loop = asyncio.get_running_loop()
        self._probe = asyncio.ensure_future(loop.run_in_executor(self._threads, self._make_probe))

    async def _close_probe(self) -> None:
        if self._probe is not None and (await asyncio.wait([self._probe])) and self._probe.exception() is None:
            await self.ask(lambda probe: probe.close())
        self._probe = None

    async def ask(self, question: Callable[[Probe], T]) -> T:
        """Put a question to the probe, in its thread."""
        if self._probe is None:
            raise OpenArmError(Code.INTERNAL, "the supervisor was not started, or is stopping")
        probe = await asyncio.shield(self._probe)
        return await asyncio.get_running_loop().run_in_executor(self._threads, question, probe)

    def tell_guard(self, line: str) -> None:
        """Send a line to the guard process."""
        if self._guard is not None and self._guard.stdin is not None and self._guard.returncode is None:
            self._guard.stdin.write(f"{line}\n".encode())

    async def _dismiss_guard(self) -> None:
        self.tell_guard("bye")
        if self._guard is not None and self._guard.stdin is not None:
            self._guard.stdin.close()
            await self._guard.wait()

    def changed(self, node: str, state: NodeState, detail: str) -> None:
        """Log, record and publish a change of a node."""
        self.say(f"{node}: {state}: {detail}")
        self.record()
        self._publish(node, state, detail)

    def say(self, text: str) -> None:
        """Write to the supervisor's log."""
        self._log.write([text])

    def log_file(self, name: str) -> LogFile:
        """Return a new log of this run."""
        path = self.run_dir / "logs" / f"{name}.log"
        self._logs.append(LogFile(path, lambda reason: self._disk_fault(path.parent, f"{reason}; log lines are lost")))
        return self._logs[-1]

    @property
    def lost_lines(self) -> int:
        """Lines that are missing in the logs."""
        return sum(log.lost for log in self._logs)

    def _disk_fault(self, folder: Path, reason: str) -> None:
        """Publish, once a folder, that it takes nothing; the nodes do not need it."""
        if folder in self._disk_faults:
            return
        self._disk_faults.add(folder)
        text = f"can't write to {folder}: {reason}; the graph goes on without it"
        self._publish("supervisor", NodeState.FAILED, text)

    def _publish(self, node: str, state: NodeState, detail: str) -> None:
        if self._listener is not None:
            self._listener(Event(time.monotonic() - self._began, node, state, detail))

    def record(self) -> None:
        """Write what `openarm ps` shows."""
        me = psutil.Process()
        nodes = {
            name: runs.NodeRecord(
                state=keeper.state,
                pid=keeper.pid,
                restarts=keeper.restarts,
                log=str(keeper.log.path),
                trouble=keeper.trouble,
            )
            for name, keeper in self._keepers.items()
        }
        record = runs.RunRecord(
            graph=self.graph.name,
            robot=robot_name(),
            pid=me.pid,
            pid_created=me.create_time(),
            domain=environment.domain_id(self.graph),
            discovery=self.graph.discovery,
            run_dir=str(self.run_dir),
            started=self._started,
            ready=all(keeper.state == NodeState.READY for keeper in self._keepers.values()),
            nodes=nodes,
        )
        try:
            runs.write_record(record)
        except OSError as error:
            self._disk_fault(runs.state_dir(), f"{error.strerror}; `openarm ps` shows an old state")
