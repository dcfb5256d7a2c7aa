# SPDX-License-Identifier: Apache-2.0
"""What the detector of a running graph sees now, as things that requests in words choose from. Base frame, m."""

from __future__ import annotations

import queue
import time
from collections.abc import Sequence

from vision_msgs.msg import Detection3D, Detection3DArray

from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.client import BackgroundNode
from openarm_common.ros.convert import xyz
from openarm_common.ros.node import reliable
from openarm_perception.detection.attributes import Thing, parse, resolve


class DetectionListener(BackgroundNode):
    """Hears what the detector finds; while it listens, the detector works."""

    def __init__(self) -> None:
        self._heard: queue.Queue[Detection3DArray] = queue.Queue()
        super().__init__("detection_listener")
        self._node.create_subscription(Detection3DArray, "/detections_3d", self._heard.put, reliable(5))

    def next(self, timeout: float) -> list[Thing]:
        """The measured objects of the next answer that has any, or of the last one.

        Raises:
            OpenArmError: TIMEOUT, when no answer comes.
        """
        deadline = time.monotonic() + timeout
        found: list[Thing] | None = None
        while not found and (left := deadline - time.monotonic()) > 0.0:
            try:
                found = things(self._heard.get(timeout=left))
            except queue.Empty:
                break
        if found is None:
            raise OpenArmError(
                Code.TIMEOUT, f"no answer of the detector within {timeout:g} s; is the graph up, and its camera?"
            )
        return found


def find(requests: Sequence[str], timeout: float = 20.0) -> list[Thing]:
    """The objects that requests in words mean, such as "red cube left of the can", as the detector sees them now.

    Raises:
        OpenArmError: TIMEOUT, when the detector says nothing; as `parse` and `resolve`.
    """
    with DetectionListener() as listener:
        seen = listener.next(timeout)
    labels = [thing.label for thing in seen]
    return [resolve(parse(request, labels), seen) for request in requests]


def things(message: Detection3DArray) -> list[Thing]:
    """The objects of a message that were measured."""
    return [_thing(d) for d in message.detections if d.results and d.results[0].hypothesis.score > 0.0]


def _thing(detection: Detection3D) -> Thing:
    names = [result.hypothesis.class_id for result in detection.results]
    position = xyz(detection.bbox.center.position)
    size = detection.bbox.size
    kind = names[1] if len(names) > 1 else names[0]
    return Thing(names[0], kind, position, (size.x, size.y, size.z), detection.results[0].hypothesis.score)
