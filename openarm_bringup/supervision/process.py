# SPDX-License-Identifier: Apache-2.0
"""One child process in a session of its own: its log, and its end by INT, TERM, KILL."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections import deque
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field

import psutil

from openarm_bringup.supervision.guard import group_alive
from openarm_bringup.supervision.log import LogFile
from openarm_common.errors import Code, OpenArmError


@dataclass
class Ladder:
    """How long processes may take after each signal, s; a second Ctrl-C ends the present wait of all of them."""

    after_int: float = 5.0
    after_term: float = 5.0
    hurried: asyncio.Event = field(default_factory=asyncio.Event)

    def hurry(self) -> None:
        """End the present stage of every stop that is under way."""
        self.hurried.set()
        self.hurried = asyncio.Event()


#: Starts a process that prints to a file, and returns its id.
Start = Callable[[int], Awaitable[int]]


def command(argv: Sequence[str], env: Mapping[str, str], *, pass_fds: Sequence[int] = ()) -> Start:
    """Start a program in a session of its own.

    Args:
        argv: The program, which PATH may lead to, and its arguments.
        env: Its whole environment.
        pass_fds: Open files that it inherits.
    """

    async def start(output: int) -> int:
        streams = [(os.POSIX_SPAWN_OPEN, 0, os.devnull, os.O_RDONLY, 0)]
        streams += [(os.POSIX_SPAWN_DUP2, output, stream) for stream in (1, 2)]
        streams += [(os.POSIX_SPAWN_DUP2, file, file) for file in pass_fds]  # inherited, as it is not without this
        try:
            # What Python ignores, a program is to begin with.
            return os.posix_spawnp(argv[0], [*argv], env, file_actions=streams, setsid=True, setsigdef=[signal.SIGPIPE])
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"{argv[0]} could not be started: {error}") from error

    return start


class NodeProcess:
    """A running child; everything it prints goes to a log file, whether or not that takes it.

    It has a session of its own, so that signals reach its whole group and none from the terminal do.
    """

    def __init__(self, pid: int, output: asyncio.StreamReader, log: LogFile) -> None:
        #: Process id, which is also the id of its group.
        self.pid = pid
        self._log = log
        log.write(())  # a node that says nothing has one too
        self.tail: deque[str] = deque(maxlen=40)
        self.killed = False
        self._pump = asyncio.create_task(self._copy(output))
        self._loop = asyncio.get_running_loop()
        self._ended: asyncio.Future[int] = self._loop.create_future()
        self._handle = os.pidfd_open(pid)
        self._loop.add_reader(self._handle, self._reap)

    @classmethod
    async def start(cls, start: Start, log: LogFile) -> NodeProcess:
        """Start a process.

        Args:
            start: Does it.
            log: File for the output of the process.

        Raises:
            OpenArmError: ENVIRONMENT, when it can't be started.
        """
        reader, writer = os.pipe()
        output = asyncio.StreamReader()
        await asyncio.get_running_loop().connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(output), os.fdopen(reader, "rb", buffering=0)
        )
        try:
            return cls(await start(writer), output, log)
        finally:
            os.close(writer)

    def _reap(self) -> None:
        self._loop.remove_reader(self._handle)
        os.close(self._handle)
        self._ended.set_result(os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1]))

    @property
    def returncode(self) -> int | None:
        """Exit code, minus the signal number, or None while it runs."""
        return self._ended.result() if self._ended.done() else None

    @property
    def stopped(self) -> bool:
        """Whether somebody has halted it: with SIGSTOP, or in a debugger."""
        try:
            return psutil.Process(self.pid).status() in (psutil.STATUS_STOPPED, psutil.STATUS_TRACING_STOP)
        except psutil.NoSuchProcess:
            return False

    def kill(self) -> None:
        """Kill it and what it has started."""
        self.killed = True
        self._signal(signal.SIGKILL)

    async def wait(self) -> int:
        """Wait for the end of the process and of everything it has started; return its exit code."""
        code = await asyncio.shield(self._ended)
        await self._end_rest_of_group()
        try:
            await asyncio.wait_for(asyncio.shield(self._pump), 1.0)
        except TimeoutError:  # something outside the group still holds the pipe
            self._pump.cancel()
        return code

    async def stop(self, ladder: Ladder) -> int:
        """Send INT, then TERM, then KILL to the group, each when the one before had no effect in time."""
        for number, grace in ((signal.SIGINT, ladder.after_int), (signal.SIGTERM, ladder.after_term)):
            self._signal(number)
            if await self._ended_within(grace, ladder.hurried):
                return await self.wait()
        self.kill()
        return await self.wait()

    async def _ended_within(self, seconds: float, hurried: asyncio.Event) -> bool:
        haste = asyncio.create_task(hurried.wait())
        await asyncio.wait({self._ended, haste}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        haste.cancel()
        return self._ended.done()

    async def _end_rest_of_group(self) -> None:
        """Kill grandchildren that outlived the process; they had its signals already."""
        for _ in range(100):
            alive = group_alive(self.pid)
            self._bury_orphans()  # after the look: none that has ended by then stays a zombie
            if not alive:
                return
            self.kill()
            await asyncio.sleep(0.02)

    def _bury_orphans(self) -> None:
        """Take note of the end of grandchildren: of a subreaper they are children."""
        with contextlib.suppress(ChildProcessError):
            while os.waitpid(-self.pid, os.WNOHANG)[0]:
                pass

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    async def _copy(self, output: asyncio.StreamReader) -> None:
        rest = b""
        while chunk := await output.read(65536):
            *lines, rest = (rest + chunk).split(b"\n")
            if len(rest) > 1_000_000:  # a line that never ends must not grow without bound
                lines, rest = [*lines, rest], b""
            self._write(lines)
        self._write([rest] if rest else [])

    def _write(self, lines: Sequence[bytes]) -> None:
        texts = [line.decode("utf-8", errors="replace").rstrip("\r") for line in lines]
        self.tail.extend(texts)
        self._log.write(texts)
