# SPDX-License-Identifier: Apache-2.0
"""Detections as messages: what is written is read again, and what was not measured stays so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vision_msgs.msg import Detection3D

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.ros.detections import UNKNOWN, class_ids, detections_from_msg, detections_to_msg

T = se3.make(se3.rot_z(0.3), (0.3, -0.2, 0.43))
CUBE = Detection("red", 0.9, T, np.array([0.050, 0.051, 0.052]), kind="cube")
CAN = Detection("blue", 0.8, T, np.array([0.066, 0.066, 0.115]), True, "can")
NONE = [np.eye(6) * 1e-6]


@pytest.mark.parametrize("detection", [CUBE, CAN, replace(CUBE, kind="")])
def test_an_object_is_read_as_it_was_written(detection: Detection) -> None:
    message = detections_to_msg([detection], NONE, "base", 7_000_000_009)
    (found,) = detections_from_msg(message)
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("base", 9)
    assert (found.label, found.score, found.measured) == (detection.label, pytest.approx(detection.score), True)
    assert (found.round, found.kind) == (detection.round, detection.kind or detection.label)
    np.testing.assert_allclose(found.T_base_object, detection.T_base_object, atol=1e-12)
    np.testing.assert_allclose(found.size, detection.size)


def test_an_object_that_was_not_measured_stays_so_and_keeps_its_score() -> None:
    message = detections_to_msg([replace(CUBE, measured=False)], NONE, "base", 0)
    assert all(result.pose.covariance[0] == UNKNOWN for result in message.detections[0].results)
    (found,) = detections_from_msg(message)
    assert (found.score, found.measured) == (pytest.approx(CUBE.score), False)


def test_equal_labels_are_numbered_and_detections_without_a_class_left_out() -> None:
    message = detections_to_msg([CUBE, CAN, CUBE, CUBE], NONE * 4, "base", 0)
    assert [item.id for item in message.detections] == ["red", "blue", "red_2", "red_3"]
    message.detections.append(Detection3D())
    assert len(detections_from_msg(message)) == 4


def test_classes_go_from_the_label_to_the_wider_kind() -> None:
    assert class_ids(CAN) == ("blue", "can", "cylinder")
    assert class_ids(replace(CUBE, label="box")) == ("box", "cube")
    assert class_ids(replace(CUBE, kind="sphere")) == ("red", "sphere")
