# SPDX-License-Identifier: Apache-2.0
"""Detections as messages: what is written is read again, and what was not measured stays so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from vision_msgs.msg import Detection3D

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.ros.detections import UNKNOWN, detections_from_msg, detections_to_msg, hypothesis

T = se3.make(se3.rot_z(0.3), (0.3, -0.2, 0.43))
CUBE = Detection("", 0.9, T, np.array([0.050, 0.051, 0.052]), kind="cube", color="red")
CAN = Detection("cola", 0.8, T, np.array([0.066, 0.066, 0.115]), True, "can", color="blue")
NONE = [np.eye(6) * 1e-6]


@pytest.mark.requirement("R-18")
@pytest.mark.parametrize(
    "detection",
    [
        CUBE,
        CAN,
        replace(CUBE, kind=""),
        replace(CUBE, color=""),
        replace(CUBE, color="", name="red"),
        replace(CAN, color="", kind=""),
        replace(CAN, name="Coca Cola 50%"),
        replace(CAN, name="Käse/Brot #2", color="gelb/grün"),
        replace(CAN, name="orange", color="orange", kind="sphere"),
        replace(CAN, name="100%/2F"),
    ],
)
def test_an_object_is_read_as_it_was_written(detection: Detection) -> None:
    """But for which role a lone word has: a colour without a name is a name. Requests ask for either alike."""
    message = detections_to_msg([detection, replace(detection, id="7.2")], NONE * 2, "base", 7_000_000_009)
    assert (message.header.frame_id, message.header.stamp.nanosec) == ("base", 9)
    assert [item.id for item in message.detections] == ["", "7.2"]
    assert [found.id for found in detections_from_msg(message)] == ["", "7.2"]
    for found in detections_from_msg(message):
        assert (found.label, found.attributes, found.kind) == (detection.label, detection.attributes, detection.kind)
        if detection.name and detection.color not in ("", detection.name):
            assert (found.name, found.color) == (detection.name, detection.color)
        assert (found.score, found.measured) == (pytest.approx(detection.score), True)
        assert found.round == (detection.round and bool(detection.kind))
        np.testing.assert_allclose(found.T_base_object, detection.T_base_object, atol=1e-12)
        np.testing.assert_allclose(found.size, detection.size)


def test_an_object_that_was_not_measured_stays_so_and_keeps_its_score() -> None:
    message = detections_to_msg([replace(CUBE, measured=False)], NONE, "base", 0)
    assert all(result.pose.covariance[0] == UNKNOWN for result in message.detections[0].results)
    (found,) = detections_from_msg(message)
    assert (found.score, found.measured) == (pytest.approx(CUBE.score), False)


def test_detections_without_a_class_are_left_out() -> None:
    message = detections_to_msg([CUBE, CAN, CUBE, CUBE], NONE * 4, "base", 0)
    message.detections.append(Detection3D())
    assert len(detections_from_msg(message)) == 4


@pytest.mark.parametrize("code", [Code.INTRINSICS_MISMATCH, Code.TABLE_MISMATCH, Code.NOTHING_DETECTED])
@pytest.mark.requirement("R-15")
def test_why_an_object_was_not_measured_is_read_again(code: Code) -> None:
    message = detections_to_msg([replace(CUBE, measured=False, code=code)], NONE, "base", 0)
    (found,) = detections_from_msg(message)
    assert (found.measured, found.code) == (False, code)


@pytest.mark.requirement("R-18")
def test_any_consumer_reads_class_colour_shape_and_wider_shape_in_this_order() -> None:
    (item,) = detections_to_msg([CAN], NONE, "base", 0).detections
    assert [result.hypothesis.class_id for result in item.results] == ["cola", "blue", "can", "cylinder"]
    assert len({result.hypothesis.score for result in item.results}) == 1
    assert replace(CUBE, color="", kind="box").attributes == ("box",)
    assert replace(CUBE, kind="sphere").attributes == ("red", "sphere")
    assert (CAN.label, CUBE.label, replace(CUBE, color="").label) == ("cola", "red", "box")


@pytest.mark.parametrize(
    ("classes", "expected"),
    [
        (("mug", "red", "cylinder"), ("mug", "red", "cylinder")),
        (("can", "blue"), ("blue", "", "can")),
        (("box",), ("", "", "box")),
        (("box", "cube"), ("", "", "cube")),
    ],
)
def test_a_message_of_another_detector_is_read_whatever_its_ids(classes, expected) -> None:
    message = detections_to_msg([CUBE], NONE, "base", 0)
    (item,) = message.detections
    for item.id in ("", "17", "a/b/c"):
        item.results = [hypothesis(name, 0.9 - 0.1 * i) for i, name in enumerate(classes)]
        (found,) = detections_from_msg(message)
        assert (found.name, found.color, found.kind) == expected
