# SPDX-License-Identifier: Apache-2.0
"""Points with the detection that each belongs to: in another frame, and as a message."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from sensor_msgs.msg import PointField

from openarm_common import se3
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.ros.labelled_clouds import labelled_cloud_from_msg, labelled_cloud_to_msg
from tests.refusals import refused

LABELS = st.lists(st.integers(0, 2**32 - 1), max_size=50)


def cloud(labels: list[int]) -> LabelledCloud:
    points = np.random.default_rng(len(labels)).normal(size=(len(labels), 3)).astype(np.float32)
    return LabelledCloud(points, np.array(labels, np.uint32), np.zeros(3))


@given(LABELS)
@settings(deadline=None)
def test_a_cloud_comes_back_from_its_message_bit_by_bit(labels: list[int]) -> None:
    before = cloud(labels)
    message = labelled_cloud_to_msg(before, "overhead_color_optical_frame", 7)
    after = labelled_cloud_from_msg(message)
    assert np.array_equal(before.points, after.points)
    assert np.array_equal(before.labels, after.labels)
    assert (message.header.frame_id, message.width, message.height) == ("overhead_color_optical_frame", len(labels), 1)


def test_points_that_are_not_finite_are_left_out() -> None:
    before = cloud([1, 2, 3])
    before.points[1, 2] = np.nan
    assert labelled_cloud_from_msg(labelled_cloud_to_msg(before, "eye", 0)).labels.tolist() == [1, 3]


def test_another_layout_is_refused() -> None:
    message = labelled_cloud_to_msg(cloud([1, 2]), "eye", 0)
    message.fields[3].datatype = PointField.FLOAT32
    refused("expected float32 x, y, z and uint32 label", labelled_cloud_from_msg, message)
    message = labelled_cloud_to_msg(cloud([1, 2]), "eye", 0)
    message.width = 3
    refused("32 bytes for 3 points", labelled_cloud_from_msg, message)


def test_the_camera_moves_with_the_points() -> None:
    T = se3.make(se3.rot_z(0.5), (1.0, 2.0, 3.0))
    moved = cloud([1]).moved(T)
    assert np.allclose(moved.camera, (1.0, 2.0, 3.0))
    assert np.allclose(moved.points[0], se3.apply(T, cloud([1]).points[0]), atol=1e-6)
