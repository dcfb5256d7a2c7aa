# SPDX-License-Identifier: Apache-2.0
"""A process that imports what nodes need, once, and forks a process for each of them.

Started as `python -m openarm_bringup.supervision.fork_server FD` by the supervisor, which asks at the other end of the
socket FD: a request is JSON, with the file for the output attached, and the answer is the process id. Modules are
imported in the order of the requests, so that the first node begins its work while those of the next are imported. A
node is forked twice: after the end of the process in between its parent is the supervisor (a child subreaper), which
learns of its end by itself, and nodes outlive this process. Nothing here makes a participant or a GL context, which
would not survive a fork; the threads that there are (of lttng-ust, which rclpy loads) only wait.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import signal
import socket
import sys
from contextlib import suppress
from functools import partial
from typing import Any

from openarm_common.forked import run_and_exit

#: Longest request, bytes; most of one is the environment.
LONGEST = 2**20
#: Of prctl(2): the name of a thread, as `ps -o comm` and top show it.
_PR_SET_NAME = 15


def main() -> None:
    """Fork a node for each request; end with the supervisor."""
    channel = socket.socket(fileno=int(sys.argv[1]))
    gc.disable()  # pages stay shared: the collector writes into what it looks at
    _load("openarm_common.ros.node")
    while True:
        request, files, _, _ = socket.recv_fds(channel, LONGEST, 1)
        if not request:
            return
        node: dict[str, Any] = json.loads(request)
        _load(node["module"])
        gc.freeze()
        if _fork(channel):
            channel.close()
            gc.enable()
            _become(node, files[0])
            run_and_exit(partial(_run, node["module"]))
        os.close(files[0])


def _load(module: str) -> None:
    """Import a module, and let it load what does not depend on parameters."""
    if module in sys.modules:
        return
    with suppress(Exception):  # its node says the same in its own log
        loaded = importlib.import_module(module)
        if hasattr(loaded, "prepare"):
            loaded.prepare()


def _fork(channel: socket.socket) -> bool:
    """Return True in a process forked twice; here, answer with its id."""
    reader, writer = os.pipe()
    between = os.fork()
    if between == 0:
        node = os.fork()
        if node == 0:
            os.close(reader)
            os.close(writer)
            return True
        os.write(writer, str(node).encode())
        os._exit(0)
    os.close(writer)
    os.waitpid(between, 0)
    channel.sendall(os.read(reader, 32))
    os.close(reader)
    return False


def _become(node: dict[str, Any], output: int) -> None:
    """Make this process what `python -m MODULE ARGS` begins as."""
    os.setsid()
    with open(os.devnull) as nothing:
        os.dup2(nothing.fileno(), 0)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.close(output)
    os.environ.clear()
    os.environ.update(node["env"])
    signal.signal(signal.SIGINT, signal.default_int_handler)
    sys.argv = [node["module"], *node["args"]]
    ctypes.CDLL(None).prctl(_PR_SET_NAME, node["name"].encode()[:15], 0, 0, 0)


def _run(module: str) -> None:
    importlib.import_module(module).main()


if __name__ == "__main__":
    main()
