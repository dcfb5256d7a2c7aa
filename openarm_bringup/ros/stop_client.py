# SPDX-License-Identifier: Apache-2.0
"""Client of the emergency stop."""

from __future__ import annotations

from std_srvs.srv import Trigger

from openarm_common.ros.client import BackgroundNode

#: Longest wait for the service, and for its answer, s.
_TIMEOUT = 5.0


def emergency_stop(*, reset: bool = False) -> tuple[bool, str]:
    """Latch the emergency stop of the joints, or release it; return whether that succeeded, and the answer.

    Raises:
        OpenArmError: NOT_READY, when no node offers it; TIMEOUT.
    """
    with BackgroundNode("stop_client", timeout=_TIMEOUT) as node:
        name = "/mujoco_bridge/reset" if reset else "/stop"
        answer: Trigger.Response = node.call(Trigger, name, Trigger.Request(), _TIMEOUT)
    return answer.success, answer.message
