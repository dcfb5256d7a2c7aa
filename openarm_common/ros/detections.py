# SPDX-License-Identifier: Apache-2.0
"""Detections to and from vision_msgs/Detection3DArray: all that is known of /detections_3d is here.

The first hypothesis is the label; others of the same score name the shape (box, cylinder, sphere, cube, can). An object
that was detected but not measured has covariance[0] = -1, the mark of ROS for an unknown value; its box encloses its
visible part.
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

from openarm_common.detection import WIDER, Detection
from openarm_common.ros.convert import header, matrix_to_pose, pose_to_matrix, vector, xyz
from openarm_common.types import Array

#: First element of the covariance of a pose that was not measured.
UNKNOWN = -1.0
#: Shapes that are round seen from above when they stand; one that lies is seldom as long as wide.
_ROUND, _AS_LONG_AS_WIDE = frozenset({"cylinder", "can", "sphere"}), 0.001


def detections_to_msg(
    detections: Sequence[Detection], covariances: Sequence[Array], frame_id: str, t_ns: int
) -> Detection3DArray:
    """Return the message of the objects of an image.

    Args:
        detections: In the frame.
        covariances: (6, 6) of the pose of each: x, y, z, roll, pitch, yaw, m and rad.
        frame_id: Of the poses.
        t_ns: Stamp of the image.
    """
    message = Detection3DArray(header=header(frame_id, t_ns))
    ids = numbered([detection.label for detection in detections])
    for name, detection, covariance in zip(ids, detections, covariances, strict=True):
        pose = matrix_to_pose(detection.T_base_object)
        uncertain = PoseWithCovariance(pose=pose, covariance=covariance.ravel())
        if not detection.measured:
            uncertain.covariance[0] = UNKNOWN
        results = [hypothesis(each, detection.score, uncertain) for each in class_ids(detection)]
        box = BoundingBox3D(center=pose, size=vector(detection.size))
        message.detections.append(Detection3D(header=message.header, results=results, bbox=box, id=name))
    return message


def detections_from_msg(message: Detection3DArray) -> tuple[Detection, ...]:
    """Return the objects of a message, in the frame that its header names; those without a hypothesis are left out.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a pose that is not one.
    """
    out: list[Detection] = []
    for item in message.detections:
        if not item.results:
            continue
        result = max(item.results, key=lambda result: result.hypothesis.score)
        best, measured = result.hypothesis, result.pose.covariance[0] != UNKNOWN
        others = [r.hypothesis.class_id for r in item.results if r.hypothesis.class_id != best.class_id]
        T, size = pose_to_matrix(item.bbox.center), xyz(item.bbox.size)
        names = {best.class_id, *others}
        is_round = bool(names & _ROUND) and abs(float(size[0] - size[1])) < _AS_LONG_AS_WIDE
        kind = others[0] if others else best.class_id
        out.append(Detection(best.class_id, best.score, T, np.asarray(size), is_round, kind, measured))
    return tuple(out)


def hypothesis(name: str, score: float, pose: PoseWithCovariance | None = None) -> ObjectHypothesisWithPose:
    """Return a class with its score, and the pose where there is one.

    Args:
        name: The class.
        score: 0 to 1.
        pose: With its covariance.
    """
    return ObjectHypothesisWithPose(
        hypothesis=ObjectHypothesis(class_id=name, score=score), pose=pose or PoseWithCovariance()
    )


def numbered(labels: Sequence[str]) -> list[str]:
    """Return ids: the labels, with a number from the second of a label on."""
    return [label if (n := labels[: i + 1].count(label)) == 1 else f"{label}_{n}" for i, label in enumerate(labels)]


def class_ids(detection: Detection) -> tuple[str, ...]:
    """Return what an object may be called: its label, its kind, and the wider kind."""
    names = (detection.label, detection.kind, WIDER.get(detection.kind, ""))
    return tuple(dict.fromkeys(name for name in names if name))
