# SPDX-License-Identifier: Apache-2.0
"""Messages to numpy and back.

Data fields are filled from `array.array`, which rclpy takes without a check of each element; they are read through
views without a copy. Images are in `images`.
"""

from __future__ import annotations

import array
import math
import sys
from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Duration, Time
from geometry_msgs.msg import Point, Pose, Quaternion, Transform, TransformStamped, Vector3
from numpy.typing import ArrayLike, NDArray
from rclpy.duration import Duration as RclDuration
from sensor_msgs.msg import CameraInfo, JointState, PointCloud2, PointField
from std_msgs.msg import Header
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import Code, OpenArmError
from openarm_common.printable import brief, brief_text
from openarm_common.robot.held import HeldBox
from openarm_common.robot.robot_state import LONGEST_NAME
from openarm_common.types import Array, Bytes, Floats

#: Nothing that a message speaks of is further away, m.
_FAR = 1e4
#: No robot has more joints.
_MOST_JOINTS = 512
#: No joint is further from its zero, rad or m.
_FARTHEST = 1e4


# --- time
def stamp_to_ns(stamp: Time | Duration) -> int:
    """Convert a stamp or duration to nanoseconds."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def ns_to_stamp(t_ns: int) -> Time:
    """Convert nanoseconds to a stamp."""
    return Time(sec=t_ns // 1_000_000_000, nanosec=t_ns % 1_000_000_000)


def header(frame_id: str, t_ns: int) -> Header:
    """Make the header of a frame and a stamp."""
    return Header(frame_id=frame_id, stamp=ns_to_stamp(t_ns))


# --- geometry
def pose_to_matrix(pose: Pose) -> Array:
    """Convert a pose to (4, 4).

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a coordinate is not finite or the quaternion is zero or not finite.
    """
    return _matrix("pose", pose.position, pose.orientation)


def _matrix(what: str, p: Point | Vector3, q: Quaternion) -> Array:
    position = (p.x, p.y, p.z)
    if not all(abs(v) <= _FAR for v in position):
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{what} position {position} is not finite, or beyond {_FAR:g} m")
    try:
        return se3.make(se3.matrix_from_quat_xyzw((q.x, q.y, q.z, q.w)), position)
    except ValueError as error:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{what} orientation: {error}") from error


def matrix_to_pose(T: Array) -> Pose:
    """Convert (4, 4) to a pose."""
    return Pose(position=point(T[:3, 3]), orientation=_quaternion(T))


def _quaternion(T: Array) -> Quaternion:
    x, y, z, w = se3.quat_xyzw_from_matrix(T[:3, :3]).tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def point(p: ArrayLike) -> Point:
    """Make a point message of three numbers."""
    x, y, z = (float(v) for v in np.asarray(p))
    return Point(x=x, y=y, z=z)


def vector(v: ArrayLike) -> Vector3:
    """Make a Vector3 message of three numbers."""
    x, y, z = (float(c) for c in np.asarray(v))
    return Vector3(x=x, y=y, z=z)


def xyz(message: Point | Vector3) -> Array:
    """Convert a point or vector message to (3,)."""
    return np.array([message.x, message.y, message.z])


def transform_to_matrix(transform: Transform) -> Array:
    """Convert a transform message to (4, 4).

    Raises:
        OpenArmError: INVALID_ARGUMENT, as `pose_to_matrix`.
    """
    return _matrix("transform", transform.translation, transform.rotation)


def matrix_to_transform(parent: str, child: str, T_parent_child: Array, t_ns: int) -> TransformStamped:
    """Make the stamped transform message of an edge.

    Args:
        parent: Frame.
        child: Frame.
        T_parent_child: (4, 4), m.
        t_ns: Stamp.
    """
    transform = Transform(translation=vector(T_parent_child[:3, 3]), rotation=_quaternion(T_parent_child))
    return TransformStamped(header=header(parent, t_ns), child_frame_id=child, transform=transform)


# --- cameras
def info_from_intrinsics(intrinsics: Intrinsics, frame_id: str, t_ns: int, baseline: float = 0.0) -> CameraInfo:
    """Make the CameraInfo of a camera without distortion.

    Args:
        intrinsics: Intrinsics of the camera.
        frame_id: Optical frame.
        t_ns: Stamp.
        baseline: Distance of the left camera of a stereo pair from this one, its right one, m; 0 of others.
    """
    info = CameraInfo(header=header(frame_id, t_ns), height=intrinsics.height, width=intrinsics.width)
    info.distortion_model = "plumb_bob"
    fx, fy, cx, cy = intrinsics.fx, intrinsics.fy, intrinsics.cx, intrinsics.cy
    info.d = [0.0] * 5
    info.k = [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]
    info.r = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
    info.p = [fx, 0.0, cx, -fx * baseline, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return info


# --- clouds
def byte_array(data: NDArray[np.generic]) -> array.array[int]:
    """Copy an array into `array.array('B')`, the one form that rclpy takes without a loop."""
    out = array.array("B")
    if data.size:  # an empty memoryview can't be cast
        out.frombytes(np.ascontiguousarray(data).data.cast("B"))
    return out


def cloud_from_points(points: Floats, frame_id: str, t_ns: int, rgb: Bytes | None = None) -> PointCloud2:
    """Make a PointCloud2 of points (n, 3) or, organised, (height, width, 3), m; NaN marks an invalid point.

    Args:
        points: float32 coordinates in `frame_id`.
        frame_id: Frame of the points.
        t_ns: Stamp.
        rgb: Colours of the same leading shape, uint8; becomes the field `rgb` as RViz reads it.
    """
    if rgb is None:
        return cloud_from_fields(("x", "y", "z"), points, frame_id, t_ns)
    colour = rgb.astype(np.uint32)
    packed = (colour[..., 0] << 16 | colour[..., 1] << 8 | colour[..., 2]).view(np.float32)
    data = np.concatenate([points, packed[..., None]], axis=-1)
    return cloud_from_fields(("x", "y", "z", "rgb"), data, frame_id, t_ns)


def cloud_from_fields(names: Sequence[str], data: Floats, frame_id: str, t_ns: int) -> PointCloud2:
    """Make a PointCloud2 of float32 fields (n, k) or, organised, (height, width, k); the first three are x, y, z, m.

    Args:
        names: Names of the fields, (k,).
        data: Their values.
        frame_id: Frame of the points.
        t_ns: Stamp.
    """
    height, width = data.shape[:2] if data.ndim == 3 else (1, data.shape[0])
    step = 4 * len(names)
    message = PointCloud2(header=header(frame_id, t_ns), height=height, width=width)
    message.point_step, message.row_step = step, step * width
    message.fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1) for i, name in enumerate(names)
    ]
    message.is_bigendian = sys.byteorder == "big"
    message.is_dense = bool(np.isfinite(data[..., :3]).all())
    message.data = byte_array(data)
    return message


#: Datatypes of sensor_msgs/PointField.
_FLOATS = {PointField.FLOAT32: np.float32, PointField.FLOAT64: np.float64}


def points_from_cloud(message: PointCloud2) -> Floats:
    """Read points (n, 3) or (height, width, 3) of a cloud: fields x, y, z of floats of 4 or 8 bytes, in either order.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another layout.
    """
    found = {f.name: (f.offset, f.datatype) for f in message.fields}
    (x, kind), (y, other), (z, last) = (found.get(axis, (0, 0)) for axis in "xyz")
    if not kind == other == last or kind not in _FLOATS or y - x != z - y:
        layout = {brief_text(name): where for name, where in list(found.items())[:6]}
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"cloud has fields {layout} (name: offset, datatype); expected x, y, z of FLOAT32 (7) or FLOAT64 (8),"
            " equally far apart",
        )
    kept = np.dtype(_FLOATS[kind]).newbyteorder(">" if message.is_bigendian else "<")
    step, width, height = message.point_step, message.width, message.height
    row = message.row_step if height > 1 else step * width
    end = max(x, z) + kept.itemsize
    size = row * max(height - 1, 0) + step * width
    if end > step or row < step * width or len(message.data) < size:
        raise OpenArmError(
            Code.INVALID_ARGUMENT,
            f"cloud of {width}×{height} points has steps {step} and {message.row_step} and {len(message.data)} bytes;"
            f" expected steps of at least {end} and {step * width}, and {size} bytes",
        )
    shape, strides = (height, width, 3), (row, step, y - x)
    buffer = np.frombuffer(message.data, np.uint8)
    points = np.ndarray(shape, kept, buffer, x, strides) if height * width else np.empty(shape, np.float32)
    points = np.require(points, np.float32, "A")
    return points[0] if height == 1 else points


# --- joint states
def joints_from_msg(message: JointState) -> JointState:
    """Return joint states whose fields fit together: a finite position of each name, other fields of as many, or none.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for others.
    """
    names, positions = message.name, message.position
    count = len(names)
    if count > _MOST_JOINTS or max(map(len, names), default=0) > LONGEST_NAME:
        text = f"joint states of {count} joints, or with a name of more than {LONGEST_NAME} characters"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"{text}; expected at most {_MOST_JOINTS} joints")
    if len(positions) != count or len(set(names)) != count:
        text = f"{len(positions)} positions of {count} joints, {len(set(names))} of them different"
        raise OpenArmError(Code.INVALID_ARGUMENT, f"joint states have {text}; expected one position of each joint")
    for field, values in (("velocities", message.velocity), ("efforts", message.effort)):
        if len(values) not in (0, count):
            raise OpenArmError(Code.INVALID_ARGUMENT, f"joint states have {len(values)} {field} of {count} joints")
    if (count and not max(map(abs, positions)) <= _FARTHEST) or not math.isfinite(sum(positions)):
        wrong = next(name for name, value in zip(names, positions, strict=True) if not abs(value) <= _FARTHEST)
        raise OpenArmError(Code.INVALID_ARGUMENT, f"joint states have a position of {brief(wrong)} that is not one")
    return message


# --- trajectories
def trajectory_to_msg(
    names: Sequence[str], t: Array, q: Array, v: Array | None = None, a: Array | None = None
) -> JointTrajectory:
    """Make a JointTrajectory of samples: times (n,) s from the start, positions, velocities, accelerations (n, k).

    Args:
        names: Joints, (k,).
        t: (n,) s.
        q: (n, k) rad or m.
        v: (n, k) rad/s or m/s; None leaves velocities out.
        a: (n, k) rad/s² or m/s²; None leaves accelerations out.
    """
    message = JointTrajectory(joint_names=list(names))
    for i, seconds in enumerate(t):
        since_start = RclDuration(nanoseconds=round(float(seconds) * 1e9)).to_msg()
        sample = JointTrajectoryPoint(positions=q[i].tolist(), time_from_start=since_start)
        if v is not None:
            sample.velocities = v[i].tolist()
        if a is not None:
            sample.accelerations = a[i].tolist()
        message.points.append(sample)
    return message


def trajectory_from_msg(message: JointTrajectory) -> tuple[list[str], Array, Array, Array | None, Array | None]:
    """Read joint names, times (n,), positions (n, k); velocities and accelerations where every point has them.

    Raises:
        OpenArmError: INVALID_ARGUMENT, when a point has another number of values than there are joints.
    """
    names, points = list(message.joint_names), message.points
    for i, p in enumerate(points):
        sizes = {"positions": len(p.positions), "velocities": len(p.velocities), "accelerations": len(p.accelerations)}
        wrong = {key: n for key, n in sizes.items() if n != len(names) and (n or key == "positions")}
        if wrong:
            key, n = next(iter(wrong.items()))
            raise OpenArmError(Code.INVALID_ARGUMENT, f"trajectory point {i} has {n} {key} for {len(names)} joints")

    def stack(key: str) -> Array | None:
        rows = [getattr(p, key) for p in points]
        return np.array(rows, dtype=np.float64) if rows and all(len(r) for r in rows) else None

    t = np.array([stamp_to_ns(p.time_from_start) * 1e-9 for p in points])
    q = np.array([p.positions for p in points], dtype=np.float64).reshape(len(points), len(names))
    return names, t, q, stack("velocities"), stack("accelerations")


def held_from_msg(message: MarkerArray) -> tuple[HeldBox, ...]:
    """Read boxes that hang on links; a message replaces the earlier one.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for a marker that is no box with edges and a pose.
    """
    boxes: list[HeldBox] = []
    for marker in message.markers:
        if marker.action in (Marker.DELETEALL, Marker.DELETE):
            boxes = [] if marker.action == Marker.DELETEALL else [box for box in boxes if box.name != marker.ns]
            continue
        size = (marker.scale.x, marker.scale.y, marker.scale.z)
        if marker.type != Marker.CUBE or not all(0.0 < edge < 2.0 for edge in size):
            raise OpenArmError(
                Code.INVALID_ARGUMENT, f"held {marker.ns!r}: expected a cube with edges of 0 .. 2 m, got {size}"
            )
        boxes.append(HeldBox(marker.ns, marker.header.frame_id, pose_to_matrix(marker.pose), size))
    return tuple(boxes)
