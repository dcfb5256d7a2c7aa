# SPDX-License-Identifier: Apache-2.0
"""Client of the emergency stop, which the node that commands the joints offers."""

from __future__ import annotations

import time

from std_srvs.srv import Trigger

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode

#: Longest wait for the service, and for its answer, s.
TIMEOUT = 5.0


def emergency_stop(*, reset: bool = False) -> tuple[bool, str]:
    """Latch the emergency stop of the joints, or release it; return whether that succeeded, and the answer.

    Raises:
        OpenArmError: NOT_READY, when no node offers it; TIMEOUT.
    """
    with BackgroundNode("stop_client", timeout=TIMEOUT) as node:
        return release(node) if reset else latch(node)


def latch(node: BackgroundNode) -> tuple[bool, str]:
    """As `emergency_stop`, by a node that is there already."""
    return _asked(node, "/stop")


def release(node: BackgroundNode) -> tuple[bool, str]:
    """As `emergency_stop` with `reset`, by a node that is there already."""
    deadline = time.monotonic() + TIMEOUT
    while not (servers := node.servers("/stop")):
        if time.monotonic() > deadline:
            raise OpenArmError(Code.NOT_READY, f"no service /stop within {TIMEOUT:g} s; is the graph up?")
        time.sleep(0.02)
    return _asked(node, f"{servers[0]}/reset")


def _asked(node: BackgroundNode, service: str) -> tuple[bool, str]:
    answer: Trigger.Response = node.call(Trigger, service, Trigger.Request(), TIMEOUT)
    return answer.success, answer.message
