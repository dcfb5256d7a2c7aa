# SPDX-License-Identifier: Apache-2.0
"""Objects that the detector of a running graph observes now, and requests in words for one of them. Base frame, m."""

from __future__ import annotations

import queue
import time
from collections.abc import Sequence

from vision_msgs.msg import Detection3DArray

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.detections import detections_from_msg
from openarm_common.ros.node import reliable
from openarm_perception.detection.attributes import parse, resolve


class DetectionListener(BackgroundNode):
    """Receives detections; the detector works only while it has a subscriber."""

    def __init__(self) -> None:
        self._received: queue.Queue[Detection3DArray] = queue.Queue()
        super().__init__("detection_listener")
        self._node.create_subscription(Detection3DArray, "/detections_3d", self._received.put, reliable(5))

    def next(self, timeout: float) -> list[Detection]:
        """Return the measured objects of the next message that has any, or of the last one.

        Raises:
            OpenArmError: TIMEOUT, when no message comes.
        """
        deadline = time.monotonic() + timeout
        found: list[Detection] | None = None
        while not found and (left := deadline - time.monotonic()) > 0.0:
            try:
                message = self._received.get(timeout=left)
            except queue.Empty:
                break
            found = [detection for detection in detections_from_msg(message) if detection.measured]
        if found is None:
            raise OpenArmError(
                Code.TIMEOUT, f"no answer of the detector within {timeout:g} s; is the graph up, and its camera?"
            )
        return found


def find(requests: Sequence[str], timeout: float = 20.0) -> list[Detection]:
    """Return the objects that requests in words select, such as "red cube left of the can".

    Raises:
        OpenArmError: TIMEOUT, when the detector publishes nothing; as `parse` and `resolve`.
    """
    with DetectionListener() as listener:
        observed = listener.next(timeout)
    labels = [item.label for item in observed]
    return [resolve(parse(request, labels), observed) for request in requests]
