# SPDX-License-Identifier: Apache-2.0
"""Objects that the detector of a running graph observes now, and requests in words for one of them. Base frame, m."""

from __future__ import annotations

from vision_msgs.msg import Detection3DArray

from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import ContextNode
from openarm_common.ros.detections import detections_from_msg
from openarm_common.ros.node import reliable
from openarm_common.wanted import select


class DetectionListener(ContextNode):
    """Receives detections; the detector works only while it has a subscriber."""

    def __init__(self) -> None:
        super().__init__("detection_listener")
        self._found: list[Detection] | None = None
        self._node.create_subscription(Detection3DArray, "/detections_3d", self._receive, reliable(5))

    def next(self, timeout: float) -> list[Detection]:
        """Return the measured objects of the first message that has any, or of the last one.

        Raises:
            OpenArmError: TIMEOUT, when no message comes.
        """
        self.spin_until(lambda: self._found, timeout)
        if self._found is None:
            raise OpenArmError(
                Code.TIMEOUT, f"no answer of the detector within {timeout:g} s; is the graph up, and its camera?"
            )
        return self._found

    def _receive(self, message: Detection3DArray) -> None:
        self._found = [detection for detection in detections_from_msg(message) if detection.measured]


def find(words: str, timeout: float = 20.0) -> Detection:
    """Return the object that words select, such as "red cube left of the can".

    Raises:
        OpenArmError: TIMEOUT, when the detector publishes nothing; as `openarm_common.wanted.select`.
    """
    with DetectionListener() as listener:
        return select(words, listener.next(timeout))[0]
