# SPDX-License-Identifier: Apache-2.0
"""Messages to numpy and back."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.ros import convert
from tests.refusals import refused


def test_stamps_keep_every_nanosecond() -> None:
    t_ns = 1_763_690_258_123_456_789
    assert convert.stamp_to_ns(convert.ns_to_stamp(t_ns)) == t_ns


@pytest.mark.parametrize("shape", [(5, 3), (4, 6, 3)])
@pytest.mark.parametrize("colour", [False, True])
def test_clouds_round_trip(shape: tuple[int, ...], colour: bool) -> None:
    points = np.random.default_rng(1).random(shape).astype(np.float32)
    rgb = np.full(shape, 200, np.uint8) if colour else None
    message = convert.cloud_from_points(points, "c", 7, rgb)
    assert message.is_dense
    assert np.array_equal(convert.points_from_cloud(message), points)
    points.reshape(-1)[0] = np.nan
    assert not convert.cloud_from_points(points, "c", 7).is_dense


def test_poses_round_trip_and_bad_ones_are_refused() -> None:
    T = se3.make(se3.exp_so3((0.1, -2.0, 0.4)), (1.0, 2.0, 3.0))
    assert np.allclose(convert.pose_to_matrix(convert.matrix_to_pose(T)), T)
    assert np.allclose(convert.transform_to_matrix(convert.matrix_to_transform("a", "b", T, 0).transform), T)
    pose = convert.matrix_to_pose(T)
    pose.position.x = float("nan")
    refused("not finite", convert.pose_to_matrix, pose)
    pose = convert.matrix_to_pose(T)
    pose.orientation.x = pose.orientation.y = pose.orientation.z = pose.orientation.w = 0.0
    refused("quaternion", convert.pose_to_matrix, pose)


def test_trajectories_round_trip_and_ragged_ones_are_refused() -> None:
    t = np.array([0.0, 0.5])
    q = np.arange(6.0).reshape(2, 3)
    message = convert.trajectory_to_msg(["a", "b", "c"], t, q, v=q * 2.0)
    names, t2, q2, v2, a2 = convert.trajectory_from_msg(message)
    assert names == ["a", "b", "c"]
    assert np.array_equal(t, t2)
    assert np.array_equal(q, q2)
    assert np.array_equal(q * 2.0, v2)
    assert a2 is None
    message.points[1].velocities = [1.0]
    refused("point 1 has 1 velocities for 3 joints", convert.trajectory_from_msg, message)


def test_a_cloud_without_points_is_a_message_too() -> None:
    cloud = convert.cloud_from_points(np.empty((0, 3), np.float32), "camera", 0)
    assert (cloud.width, cloud.height, len(cloud.data)) == (0, 1, 0)
    assert convert.points_from_cloud(cloud).shape == (0, 3)
