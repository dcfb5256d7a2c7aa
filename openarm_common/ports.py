# SPDX-License-Identifier: Apache-2.0
"""UDP ports of processes that died, kept from their successors.

Fast DDS numbers its ports in shared memory as those of UDP, and takes the lowest that are free. A process that is
started again would get the numbers of the one that was killed, while all others still write into the memory of that
one: they notice after 2 to 4 s, or never when it died in the middle of a message (eProsima/Fast-DDS#4728). With other
numbers they reach it at once.
"""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterable

import psutil

#: Of a domain, by the DDS interoperability protocol.
_FIRST, _PER_DOMAIN = 7400, 250
#: Participants forget one that is silent for its lease: 4 s, in the profiles config/fastdds*.xml.
_KEPT_S = 6.0


def in_domain(port: int, domain: int) -> bool:
    """Whether a port belongs to a ROS domain."""
    return (port - _FIRST) // _PER_DOMAIN == domain


def unicast(port: int) -> bool:
    """Whether a port is one on which a participant takes messages; it takes discovery on the one before."""
    offset = (port - _FIRST) % _PER_DOMAIN
    return offset > 10 and offset % 2 == 1


def used_by(pid: int, domain: int) -> frozenset[int]:
    """Return the UDP ports of a domain on which a process and those below it listen; none when it has ended."""
    try:
        process = psutil.Process(pid)
        family = [process, *process.children(recursive=True)]
        found = [c.laddr.port for one in family for c in one.net_connections("udp") if c.laddr]
    except psutil.Error:
        return frozenset()
    return frozenset(port for port in found if in_domain(port, domain))


def held(ports: Iterable[int]) -> contextlib.ExitStack:
    """Return a context in which no other socket can have those of the ports that are free."""
    stack = contextlib.ExitStack()
    for port in ports:
        one = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            one.bind(("", port))
        except OSError:  # of several participants, as those for multicast
            one.close()
        else:
            stack.enter_context(one)
    return stack


class HeldPorts:
    """Holds ports for as long as others may take their next owner for the last one."""

    def __init__(self) -> None:
        self._held: set[contextlib.ExitStack] = set()

    def hold(self, ports: Iterable[int]) -> None:
        """Hold those that are free; in the loop of the supervisor."""
        taken = held(ports)
        self._held.add(taken)
        asyncio.get_running_loop().call_later(_KEPT_S, self._release, taken)

    def close(self) -> None:
        """Release all."""
        for taken in tuple(self._held):
            self._release(taken)

    def _release(self, taken: contextlib.ExitStack) -> None:
        taken.close()
        self._held.discard(taken)
