# SPDX-License-Identifier: Apache-2.0
"""Messages to numpy and back."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_msgs.msg import Image

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code
from openarm_common.ros import convert
from tests.refusals import refused


def test_stamps_keep_every_nanosecond() -> None:
    t_ns = 1_763_690_258_123_456_789
    assert convert.stamp_to_ns(convert.ns_to_stamp(t_ns)) == t_ns


@pytest.mark.parametrize("encoding", sorted(convert.ENCODINGS))
def test_images_round_trip_without_loss(encoding: str) -> None:
    dtype, channels = convert.ENCODINGS[encoding]
    rng = np.random.default_rng(0)
    pixels = (rng.random((4, 6, channels) if channels > 1 else (4, 6)) * 200).astype(dtype)
    message = convert.array_to_image(pixels, encoding, "cam", 5)
    assert np.array_equal(convert.image_to_array(message), pixels)
    assert message.header.frame_id == "cam"


def test_rows_with_padding_are_read() -> None:
    message = Image(height=2, width=3, encoding="mono8", step=4)
    message.data = bytes([1, 2, 3, 0, 4, 5, 6, 0])
    assert np.array_equal(convert.image_to_array(message), [[1, 2, 3], [4, 5, 6]])


def test_big_endian_depth_is_read() -> None:
    message = Image(height=1, width=2, encoding="16UC1", step=4, is_bigendian=1)
    message.data = bytes([0x03, 0xE8, 0x00, 0x01])
    assert np.array_equal(convert.image_to_array(message), [[1000, 1]])


@pytest.mark.parametrize(("encoding", "size"), [("yuv422", 12), ("mono8", 11), ("rgb8", 12)])
@pytest.mark.requirement("B-28")
def test_a_bad_image_is_refused_by_name(encoding: str, size: int) -> None:
    message = Image(height=3, width=4, encoding=encoding, step=4)
    message.data = bytes(size)
    error = refused(None, convert.image_to_array, message)
    assert error.code is Code.BAD_IMAGE
    assert encoding in error.message


@pytest.mark.requirement("A-30")
def test_camera_info_carries_the_intrinsics() -> None:
    k = Intrinsics.from_fovy(640, 480, 60.0)
    assert convert.intrinsics_from_info(convert.info_from_intrinsics(k, "c", 0)) == k


def test_an_uncalibrated_or_distorted_camera_is_refused() -> None:
    info = convert.info_from_intrinsics(Intrinsics.from_fovy(640, 480, 60.0), "c", 0)
    info.d = [0.1, 0.0, 0.0, 0.0, 0.0]
    refused("distortion", convert.intrinsics_from_info, info)
    info.k = [0.0] * 9
    refused("not calibrated", convert.intrinsics_from_info, info)


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
