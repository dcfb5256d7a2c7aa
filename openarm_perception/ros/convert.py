# SPDX-License-Identifier: Apache-2.0
"""Detections as messages."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from rclpy.duration import Duration
from std_msgs.msg import ColorRGBA
from vision_msgs.msg import BoundingBox2D, Detection2DArray
from vision_msgs.msg import Detection2D as Detection2DMsg
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common.ros.convert import header, matrix_to_pose, vector
from openarm_common.ros.detections import hypothesis
from openarm_perception.detection.localize import LocatedObject
from openarm_perception.detection.pipeline import Perceived

#: Markers of objects vanish this long after the last frame that showed them, s.
MARKER_LIFETIME = 2.0


def detections_2d(perceived: Perceived, frame_id: str, t_ns: int) -> Detection2DArray:
    """Boxes by their centre, pixels; a box in an image has no pose, and no shape but that which a network knows.

    Args:
        perceived: Objects of the image; what is not in space either has no id.
        frame_id: Frame of the image.
        t_ns: Stamp.
    """
    message = Detection2DArray(header=header(frame_id, t_ns))
    ids = {id(place.source): place.id for place in perceived.boxes}
    for detection in perceived.found:
        box = BoundingBox2D(size_x=float(detection.size[0]), size_y=float(detection.size[1]))
        box.center.position.x, box.center.position.y = detection.centre
        results = [hypothesis(attribute, detection.score) for attribute in detection.attributes]
        name = ids.get(id(detection), "")
        message.detections.append(Detection2DMsg(header=message.header, results=results, bbox=box, id=name))
    return message


def mask_image(perceived: Perceived, shape: tuple[int, int]) -> NDArray[np.uint8]:
    """Return which pixel (h, w) belongs to which object.

    Returns:
        0: to none, also where the robot is; i: to the i-th of `perceived.found`, which is the i-th of /detections_2d,
        counted from 1; those from the 256th on are left out.
    """
    image = np.zeros(shape, np.uint8)
    for i, detection in enumerate(perceived.found[:255], 1):
        (u, v), (w, h) = detection.origin, detection.size
        image[v : v + h, u : u + w][detection.mask] = i
    if perceived.robot is not None:
        image[perceived.robot] = 0
    return image


def markers(located: Sequence[LocatedObject], frame_id: str, t_ns: int) -> MarkerArray:
    """Return a transparent body and a text for each object.

    Args:
        located: Objects in the frame.
        frame_id: Frame of the poses.
        t_ns: Stamp.
    """
    message = MarkerArray(markers=[Marker(header=header(frame_id, t_ns), action=Marker.DELETEALL)])
    lifetime = Duration(seconds=MARKER_LIFETIME).to_msg()
    for i, detection in enumerate(located):
        body = Marker(header=header(frame_id, t_ns), ns="objects", id=i, lifetime=lifetime)
        body.type = Marker.CYLINDER if detection.round else Marker.CUBE
        body.pose = matrix_to_pose(detection.T_base_object)
        body.scale = vector(detection.size)
        body.color = ColorRGBA(r=0.2, g=0.9, b=0.9, a=0.45)
        text = Marker(header=header(frame_id, t_ns), ns="labels", id=i, lifetime=lifetime)
        text.type = Marker.TEXT_VIEW_FACING
        text.text = f"{detection.label} {detection.score:.2f}" + (f" #{detection.id}" if detection.id else "")
        text.pose.position.x, text.pose.position.y = body.pose.position.x, body.pose.position.y
        text.pose.position.z = body.pose.position.z + detection.size[2] / 2.0 + 0.03
        text.scale.z = 0.025
        text.color = ColorRGBA(r=1.0, g=1.0, b=1.0, a=1.0)
        message.markers += [body, text]
    return message
