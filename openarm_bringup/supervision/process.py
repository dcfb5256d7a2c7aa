# SPDX-License-Identifier: Apache-2.0
"""One child process in a session of its own: its log, and its end by INT, TERM, KILL."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
from collections import deque
from collections.abc import Mapping, Sequence
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


class NodeProcess:
    """A running child; everything it prints goes to a log file, whether or not that takes it."""

    def __init__(self, process: asyncio.subprocess.Process, log: LogFile) -> None:
        self._process = process
        self._log = log
        log.write(())  # a node that says nothing has one too
        self.tail: deque[str] = deque(maxlen=40)
        self.killed = False
        self._pump = asyncio.create_task(self._copy_output())

    @classmethod
    async def start(
        cls, argv: Sequence[str], env: Mapping[str, str], log: LogFile, *, pass_fds: Sequence[int] = ()
    ) -> NodeProcess:
        """Start a command in a new session, so that signals reach its whole group and none from the terminal do.

        Args:
            argv: The command.
            env: Its whole environment.
            log: For what it prints.
            pass_fds: Open files that it inherits.

        Raises:
            OpenArmError: ENVIRONMENT, when the command can't be started.
        """
        try:
            process = await asyncio.create_subprocess_exec(
                *argv,
                env=dict(env),
                stdin=asyncio.subprocess.DEVNULL,
                stdout=asyncio.subprocess.PIPE,
                stderr=asyncio.subprocess.STDOUT,
                start_new_session=True,
                pass_fds=pass_fds,
            )
        except OSError as error:
            raise OpenArmError(Code.ENVIRONMENT, f"{argv[0]} could not be started: {error}") from error
        return cls(process, log)

    @property
    def pid(self) -> int:
        """Process id, which is also the id of its group."""
        return self._process.pid

    @property
    def returncode(self) -> int | None:
        """Exit code, minus the signal number, or None while it runs."""
        return self._process.returncode

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
        code = await self._process.wait()
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
        ended, haste = asyncio.create_task(self._process.wait()), asyncio.create_task(hurried.wait())
        done, pending = await asyncio.wait({ended, haste}, timeout=seconds, return_when=asyncio.FIRST_COMPLETED)
        for task in pending:
            task.cancel()
        return ended in done

    async def _end_rest_of_group(self) -> None:
        """Kill grandchildren that outlived the process; they had its signals already."""
        for _ in range(100):
            if not group_alive(self.pid):
                return
            self.kill()
            await asyncio.sleep(0.02)

    def _signal(self, number: int) -> None:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, number)

    async def _copy_output(self) -> None:
        stream = self._process.stdout
        if stream is None:
            return
        rest = b""
        while chunk := await stream.read(65536):
            *lines, rest = (rest + chunk).split(b"\n")
            if len(rest) > 1_000_000:  # a line that never ends must not grow without bound
                lines, rest = [*lines, rest], b""
            self._write(lines)
        self._write([rest] if rest else [])

    def _write(self, lines: Sequence[bytes]) -> None:
        texts = [line.decode("utf-8", errors="replace").rstrip("\r") for line in lines]
        self.tail.extend(texts)
        self._log.write(texts)
