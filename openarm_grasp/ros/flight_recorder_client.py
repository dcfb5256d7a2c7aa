# SPDX-License-Identifier: Apache-2.0
"""Asks the flight recorder of the graph, where there is one, to keep what led to a failure."""

from __future__ import annotations

from typing import Any

from openarm_interfaces.srv import SaveRecording
from rclpy.task import Future

from openarm_common.errors import Code
from openarm_common.ros.node import BaseNode
from openarm_grasp.requests.request import GraspOutcome, GraspRequest, command

#: Longest wait for the path, s of wall clock: the answer to the request waits as long.
_WAIT_S = 0.8
#: These failures are of the request, not of the robot.
_OF_REQUEST = (Code.BUSY, Code.INVALID_ARGUMENT)


class FlightRecorderClient:
    """Client of /flight_recorder/save.

    Args:
        node: The node that owns the client.
    """

    def __init__(self, node: BaseNode[Any]) -> None:
        self._node = node
        self._client = node.create_client(SaveRecording, "/flight_recorder/save")

    async def save(self, outcome: GraspOutcome, request: GraspRequest) -> str:
        """Return the path of the recording of a failure; "" for a success, for a dry run, and when nobody records."""
        if outcome.kind in ("SUCCESS", "CANCELLED") or outcome.code in _OF_REQUEST or request.dry_run:
            return ""
        if not self._client.service_is_ready():
            return ""
        reason = f"{outcome.code}: {_line(outcome.message)}\nrequest: {_line(repr(request))}\nagain: {command(request)}"
        answer: Any = self._client.call_async(SaveRecording.Request(reason=reason))
        ended = Future(executor=self._node.executor)
        timer = self._node.create_timer(_WAIT_S, lambda: _end(ended), clock=self._node.steady_clock)
        answer.add_done_callback(lambda _: _end(ended))
        await ended
        self._node.destroy_timer(timer)
        if not answer.done():
            self._client.remove_pending_request(answer)
            self._node.get_logger().warning(f"the flight recorder has not answered within {_WAIT_S:g} s")
            return ""
        return answer.result().path


def _line(text: str) -> str:
    return " ".join(text.split())


def _end(future: Future) -> None:
    if not future.done():
        future.set_result(None)
