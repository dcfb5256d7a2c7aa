# SPDX-License-Identifier: Apache-2.0
"""Detections to and from vision_msgs/Detection3DArray: all that is known of /detections_3d is here.

The hypotheses of an object are its attributes: name, colour, shape, wider shape, those that are known, all of the same
score; the label comes first. Of the classes of a message those that name a shape are the shape (the narrower one, such
as cube of box and cube), the best of the others the name, the next the colour: where an object has one of both, it is
read as the name. An object has the same id in all images that show it. One that was detected but not measured has a
negative covariance[0] (-1 is the mark of ROS for an unknown value), which says why; its box encloses its visible part.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from geometry_msgs.msg import PoseWithCovariance
from vision_msgs.msg import (
    BoundingBox3D,
    Detection3D,
    Detection3DArray,
    ObjectHypothesis,
    ObjectHypothesisWithPose,
)

from openarm_common.detection import KINDS, WIDER, Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief, check_length
from openarm_common.ros.convert import header, matrix_to_pose, pose_to_matrix, vector, xyz
from openarm_common.types import Array

#: First element of the covariance of a pose that was not measured; and what it is for other reasons than the image.
UNKNOWN = -1.0
_MARKS = {Code.INTRINSICS_MISMATCH: -2.0, Code.TABLE_MISMATCH: -3.0}
_REASONS = {mark: code for code, mark in _MARKS.items()}
#: Shapes that are round seen from above when they stand; one that lies is seldom as long as wide.
#: Longest edge of an object, m.
_LARGEST = 10.0
_ROUND, _AS_LONG_AS_WIDE = frozenset({"cylinder", "can", "sphere"}), 0.001


def detections_to_msg(
    detections: Sequence[Detection], covariances: Sequence[Array], frame_id: str, t_ns: int
) -> Detection3DArray:
    """Return the message of the objects of an image.

    Args:
        detections: Detections in the frame.
        covariances: (6, 6) of the pose of each: x, y, z, roll, pitch, yaw, m and rad.
        frame_id: Frame of the poses.
        t_ns: Stamp of the image.
    """
    message = Detection3DArray(header=header(frame_id, t_ns))
    for detection, covariance in zip(detections, covariances, strict=True):
        pose = matrix_to_pose(detection.T_base_object)
        uncertain = PoseWithCovariance(pose=pose, covariance=covariance.ravel())
        if not detection.measured:
            uncertain.covariance[0] = _MARKS.get(detection.code, UNKNOWN)
        results = [hypothesis(each, detection.score, uncertain) for each in detection.attributes]
        box = BoundingBox3D(center=pose, size=vector(detection.size))
        message.detections.append(Detection3D(header=message.header, results=results, bbox=box, id=detection.id))
    return message


def detections_from_msg(message: Detection3DArray) -> tuple[Detection, ...]:
    """Return the objects of a message, in the frame that its header names; those without a hypothesis are left out.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pose or a size that is not one, a score that is no number, or a long text.
    """
    out: list[Detection] = []
    for item in message.detections:
        if not item.results:
            continue
        for text in (item.id, *(each.hypothesis.class_id for each in item.results)):
            check_length(text, "the id or class of a detection")
        result = max(item.results, key=lambda result: result.hypothesis.score)
        best, variance = result.hypothesis, result.pose.covariance[0]
        others = [r.hypothesis.class_id for r in item.results if r.hypothesis.class_id != best.class_id]
        name, color, kind = _attributes([best.class_id, *others])
        T, size = pose_to_matrix(item.bbox.center), np.asarray(xyz(item.bbox.size))
        if not ((size >= 0.0) & (size <= _LARGEST)).all() or not np.isfinite([best.score, variance]).all():
            text = f"{size.tolist()} m, score {best.score:g}, covariance {variance:g}"
            raise OpenArmError(Code.INVALID_ARGUMENT, f"detection {brief(name)} has the size {text}")
        is_round = kind in _ROUND and abs(float(size[0] - size[1])) < _AS_LONG_AS_WIDE
        code = _REASONS.get(variance, Code.NOTHING_DETECTED)
        out.append(Detection(name, best.score, T, size, is_round, kind, variance >= 0.0, code, color, item.id))
    return tuple(out)


def hypothesis(name: str, score: float, pose: PoseWithCovariance | None = None) -> ObjectHypothesisWithPose:
    """Return a class with its score, and the pose where there is one.

    Args:
        name: The class.
        score: 0 to 1.
        pose: Pose with its covariance.
    """
    return ObjectHypothesisWithPose(
        hypothesis=ObjectHypothesis(class_id=name, score=score), pose=pose or PoseWithCovariance()
    )


def _attributes(classes: Sequence[str]) -> tuple[str, str, str]:
    """Return name, colour and shape by what classes are, the best first."""
    name, color, *_ = (*(each for each in classes if each not in KINDS), "", "")
    kind = next((each for each in classes if each in KINDS), "")
    return name, color, next((each for each in classes if WIDER.get(each) == kind), kind)
