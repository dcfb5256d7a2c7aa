# SPDX-License-Identifier: Apache-2.0
"""Messages to numpy and back."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import PointCloud2, PointField

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


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("kind", "first", "step"), [("f4", 0, 22), ("f4", 4, 26), ("f8", 0, 32), ("f4", 16, 48)])
@pytest.mark.parametrize("padding", [0, 7])
def test_clouds_of_drivers_are_read_in_any_layout(order: str, kind: str, first: int, step: int, padding: int) -> None:
    """As those of lidars: 22 bytes a point of Velodyne, 26 of Livox; gaps, rows with padding, either byte order."""
    points = np.random.default_rng(1).random((4, 6, 3)).astype(np.float32)
    size = np.dtype(kind).itemsize
    formats = {"names": list("xyz"), "formats": [order + kind] * 3, "offsets": [first + size * i for i in range(3)]}
    table = np.zeros((4, 6), np.dtype({**formats, "itemsize": step}))
    for i, axis in enumerate("xyz"):
        table[axis] = points[..., i]
    rows = np.pad(np.frombuffer(table.tobytes(), np.uint8).reshape(4, -1), ((0, 0), (0, padding)))
    message = PointCloud2(height=4, width=6, is_bigendian=order == ">", point_step=step, row_step=6 * step + padding)
    datatype = {"f4": PointField.FLOAT32, "f8": PointField.FLOAT64}[kind]
    message.fields = [PointField(name="intensity", offset=first + 3 * size, datatype=2, count=1)]
    message.fields += [
        PointField(name=a, offset=first + size * i, datatype=datatype, count=1) for i, a in enumerate("xyz")
    ]
    message.data = rows.tobytes()
    read = convert.points_from_cloud(message)
    np.testing.assert_array_equal(read, points)
    assert (read.dtype, read.flags.aligned) == (np.float32, True)
    message.data = rows.tobytes()[: -padding - 1]
    refused("expected steps of at least", convert.points_from_cloud, message)
    message.fields[1].datatype = PointField.INT16
    refused("expected x, y, z of FLOAT32", convert.points_from_cloud, message)
