# SPDX-License-Identifier: Apache-2.0
"""The socket at which the command line asks a graph, and the daemon that answers there.

The supervisor opens the socket and hands it over to the daemon, a process of its own: a fault there is none of the
graph. It is started at the first connection, or when the graph is ready, and again when it has ended.
"""

from __future__ import annotations

import asyncio
import os
import socket
import sys
from contextlib import suppress
from typing import TYPE_CHECKING

from openarm_bringup.supervision import environment, shm
from openarm_bringup.supervision.process import NodeProcess, command
from openarm_bringup.supervision.state import is_private, socket_path
from openarm_common.errors import OpenArmError

if TYPE_CHECKING:
    from openarm_bringup.supervision.supervisor import Supervisor

_MODULE = "openarm_bringup.daemon"
#: Clients that may wait for the daemon.
_WAITING = 32
#: Pause after a daemon that has failed, s.
_PAUSE_S = 1.0


class Activation:
    """Keeps the daemon of a graph.

    Args:
        supervisor: Supervisor of the graph.
    """

    def __init__(self, supervisor: Supervisor) -> None:
        #: Names in /dev/shm that the daemon has used.
        self.mapped: set[str] = set()
        self._supervisor = supervisor
        self._path = socket_path(os.getpid())
        self._socket: socket.socket | None = None
        self._asked = asyncio.Event()
        self._process: NodeProcess | None = None
        self._keeping: asyncio.Task[None] | None = None

    def open(self) -> None:
        """Open the socket; where that is not possible, commands join the graph by themselves."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            folder = self._path.parent
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            if not is_private(folder):
                raise PermissionError(f"{folder} is not this user's alone")
            self._path.unlink(missing_ok=True)
            listener.bind(str(self._path))
            self._path.chmod(0o600)  # the folder has let nobody in meanwhile
            listener.listen(_WAITING)
        except OSError as error:
            listener.close()
            self._supervisor.say(f"no socket for the command line: {error}")
            return
        self._socket = listener
        self._keeping = asyncio.create_task(self._keep(listener))

    def start(self) -> None:
        """Start the daemon now, before it is asked."""
        self._asked.set()

    async def close(self) -> None:
        """End the daemon and remove the socket."""
        if self._keeping is not None:
            self._keeping.cancel()
            await asyncio.gather(self._keeping, return_exceptions=True)
        if self._process is not None and self._process.returncode is None:
            self.mapped |= shm.mapped_by(self._process.pid)
            await self._process.stop(self._supervisor.ladder)
            self._supervisor.tell_guard(f"-{self._process.pid}")
        if self._socket is not None:
            self._socket.close()
            with suppress(OSError):
                self._path.unlink(missing_ok=True)

    async def _keep(self, listener: socket.socket) -> None:
        supervisor, loop = self._supervisor, asyncio.get_running_loop()
        env = environment.client_environment(supervisor.graph, supervisor.run_dir)
        argv = [sys.executable, "-m", _MODULE, str(listener.fileno()), str(environment.domain_id(supervisor.graph))]
        log = supervisor.log_file("daemon")
        while True:
            loop.add_reader(listener, self._asked.set)
            try:
                await self._asked.wait()
            finally:
                loop.remove_reader(listener)
                self._asked.clear()
            try:
                async with supervisor.spawning:
                    process = await NodeProcess.start(command(argv, env, pass_fds=[listener.fileno()]), log)
                    self._process = process
                    supervisor.tell_guard(f"+{process.pid}")
                code = await process.wait()
                supervisor.tell_guard(f"-{process.pid}")
            except OpenArmError as error:
                code = str(error)
            if code == 0:  # its code has changed: the next answers
                continue
            supervisor.say(f"the daemon ended ({code}); its log is {log.path}")
            await asyncio.to_thread(shm.clean_shm)
            await asyncio.sleep(_PAUSE_S)
            _turn_away(listener)


def _turn_away(listener: socket.socket) -> None:
    """Let clients that wait for a daemon do their work themselves."""
    listener.setblocking(False)  # the daemon may have changed it
    with suppress(BlockingIOError):
        while True:
            listener.accept()[0].close()
