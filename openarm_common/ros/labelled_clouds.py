# SPDX-License-Identifier: Apache-2.0
"""Labelled clouds to and from sensor_msgs/PointCloud2: fields x, y, z (float32) and label (uint32), as PCL has XYZL."""

from __future__ import annotations

import sys

import numpy as np
from sensor_msgs.msg import PointCloud2, PointField

from openarm_common.errors import Code, OpenArmError
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.printable import brief
from openarm_common.ros.convert import byte_array, header

_FIELDS = (
    ("x", 0, PointField.FLOAT32),
    ("y", 4, PointField.FLOAT32),
    ("z", 8, PointField.FLOAT32),
    ("label", 12, PointField.UINT32),
)
_STEP = 16


def labelled_cloud_to_msg(cloud: LabelledCloud, optical_frame: str, t_ns: int) -> PointCloud2:
    """Return the message of a cloud in the frame of its camera.

    Args:
        cloud: The cloud.
        optical_frame: Optical frame of the camera, whose origin is where the image was taken from.
        t_ns: Stamp of the image.
    """
    message = PointCloud2(header=header(optical_frame, t_ns), height=1, width=len(cloud.points), is_dense=True)
    message.fields = [PointField(name=name, offset=at, datatype=kind, count=1) for name, at, kind in _FIELDS]
    message.point_step, message.row_step = _STEP, _STEP * len(cloud.points)
    message.is_bigendian = sys.byteorder == "big"
    rows = np.empty((len(cloud.points), 4), np.float32)
    rows[:, :3], rows[:, 3] = cloud.points, cloud.labels.view(np.float32)
    message.data = byte_array(rows)
    return message


def labelled_cloud_from_msg(message: PointCloud2) -> LabelledCloud:
    """Return the cloud of a message, in the frame that its header names; points that are not finite are left out.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another layout.
    """
    layout = [(field.name, field.offset, field.datatype) for field in message.fields[:5]]
    size = message.height * message.width
    if tuple(layout) != _FIELDS or message.point_step != _STEP or len(message.data) != _STEP * size:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"a labelled cloud has the fields {brief(str(layout))} in steps of {message.point_step} bytes and"
            f" {len(message.data)} bytes for {size} points; expected float32 x, y, z and uint32 label, without gaps",
        )
    rows = np.frombuffer(message.data, np.float32).reshape(size, 4)
    rows = rows[np.isfinite(rows[:, :3]).all(axis=1)]
    return LabelledCloud(rows[:, :3].copy(), rows[:, 3].copy().view(np.uint32), np.zeros(3))
