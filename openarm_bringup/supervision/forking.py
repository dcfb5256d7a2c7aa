# SPDX-License-Identifier: Apache-2.0
"""Nodes that are forked from one process, which has imported what they need (`supervision.fork_server`)."""

from __future__ import annotations

import asyncio
import ctypes
import json
import socket
import sys
from collections.abc import Mapping, Sequence

from openarm_bringup.supervision import fork_server
from openarm_bringup.supervision.log import LogFile
from openarm_bringup.supervision.process import NodeProcess, Start, command

#: Of prctl(2): orphans below this process become its children.
_PR_SET_CHILD_SUBREAPER = 36


class ForkServer:
    """The supervisor's end of a fork server.

    Args:
        channel: Channel to the server.
        process: Process that it runs in.
    """

    def __init__(self, channel: socket.socket, process: NodeProcess) -> None:
        self._channel = channel
        self.process = process
        self._asking = asyncio.Lock()

    @classmethod
    async def open(cls, env: Mapping[str, str], log: LogFile) -> ForkServer:
        """Start a server; it begins to import what all nodes need.

        Args:
            env: Environment of the server; libraries read it when they are imported.
            log: File for the output of the server itself.

        Raises:
            OpenArmError: ENVIRONMENT, when it can't be started.
        """
        channel, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        channel.setblocking(False)
        argv = [sys.executable, "-m", fork_server.__name__, str(other.fileno())]
        _adopt_orphans(True)
        with other:
            return cls(channel, await NodeProcess.start(command(argv, env, pass_fds=[other.fileno()]), log))

    def node(self, name: str, argv: Sequence[str], env: Mapping[str, str]) -> Start:
        """Start `python -m MODULE ARGS`, forked; without a server, as any command.

        Args:
            name: Name of the process.
            argv: The command.
            env: Its whole environment.
        """
        _, _, module, *args = argv
        request = json.dumps({"name": name, "module": module, "args": args, "env": dict(env)}).encode()

        async def start(output: int) -> int:
            async with self._asking:
                try:
                    socket.send_fds(self._channel, [request], [output])
                    answer = await asyncio.get_running_loop().sock_recv(self._channel, 32)
                except OSError:
                    answer = b""
            return int(answer) if answer else await command(argv, env)(output)

        return start

    async def close(self) -> None:
        """End the server; its nodes go on."""
        self._channel.close()
        self.process.kill()  # it has nothing to tidy up, and may be in the middle of an import
        await self.process.wait()
        _adopt_orphans(False)


def _adopt_orphans(yes: bool) -> None:
    ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, int(yes), 0, 0, 0)
