# SPDX-License-Identifier: Apache-2.0
"""A stored calibration as other tools read it: easy_handeye2, static_transform_publisher, URDF, camera_info."""

from __future__ import annotations

from typing import Any
from xml.sax.saxutils import quoteattr

import yaml

from openarm_calibration.store.store import StoredCalibration
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL
from openarm_common.camera.lens_files import camera_info
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

FORMATS = ("easy_handeye2", "static_transform", "urdf", "camera_info")


def exported(item: StoredCalibration, form: str, *, optical: bool, child: str = "", in_hand: bool = True) -> str:
    """Return a calibration in the form of another tool.

    Args:
        item: Stored.
        form: One of `FORMATS`.
        optical: Whether the child frame is the optical one (z forward), not the camera's link (x forward).
        child: Its name; "": as of this suite's cameras.
        in_hand: Whether the camera moves with the arm.

    Raises:
        OpenArmError: INVALID_ARGUMENT, for another form, or intrinsics that the calibration does not have.
    """
    if form not in FORMATS:
        raise OpenArmError(Code.INVALID_ARGUMENT, f"no format {form!r}; formats: {', '.join(FORMATS)}")
    if form == "camera_info":
        if item.intrinsics is None:
            raise OpenArmError(
                Code.INVALID_ARGUMENT,
                f"the calibration of {item.camera!r} has no intrinsics: it is of pose pairs, or old",
            )
        return camera_info(item.camera, item.intrinsics)
    T = item.T_parent_link @ T_LINK_OPTICAL if optical else item.T_parent_link
    child = child or f"{item.camera}_{'color_optical_frame' if optical else 'link'}"
    if form == "easy_handeye2":
        return _easy_handeye2(item, T, child, in_hand)
    return _static_transform(item, T, child) if form == "static_transform" else _urdf(item, T, child)


def _easy_handeye2(item: StoredCalibration, T: Array, child: str, in_hand: bool) -> str:
    """Return the message HandeyeCalibration as YAML, a file NAME.calib."""
    x, y, z, w = se3.quat_xyzw_from_matrix(T[:3, :3]).tolist()
    position = dict(zip("xyz", T[:3, 3].tolist(), strict=True))
    document: dict[str, Any] = {
        "parameters": {
            "name": item.camera,
            "calibration_type": "eye_in_hand" if in_hand else "eye_on_base",
            "robot_base_frame": "" if in_hand else item.parent,
            "robot_effector_frame": item.parent if in_hand else "",
            "tracking_base_frame": child,
            "tracking_marker_frame": "",
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {"translation": position, "rotation": {"x": x, "y": y, "z": z, "w": w}},
    }
    return yaml.safe_dump(document, sort_keys=False)


def _static_transform(item: StoredCalibration, T: Array, child: str) -> str:
    """Return an element of an XML launch file."""
    names = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    values = (*T[:3, 3].tolist(), *se3.quat_xyzw_from_matrix(T[:3, :3]).tolist())
    numbers = " ".join(f"{name} {value:.9f}" for name, value in zip(names, values, strict=True))
    args = f"{numbers} --frame-id {item.parent} --child-frame-id {child}"
    name = quoteattr(f"{item.camera}_mount")
    return f'<node pkg="tf2_ros" exec="static_transform_publisher" name={name} args={quoteattr(args)}/>\n'


def _urdf(item: StoredCalibration, T: Array, child: str) -> str:
    """Return a link and the fixed joint that carries it."""
    xyz = " ".join(f"{value:.9f}" for value in T[:3, 3].tolist())
    rpy = " ".join(f"{value:.9f}" for value in se3.rpy_from_matrix(T[:3, :3]))
    return (
        f"<link name={quoteattr(child)}/>\n"
        f'<joint name={quoteattr(f"{item.camera}_mount")} type="fixed">\n'
        f"  <parent link={quoteattr(item.parent)}/>\n"
        f"  <child link={quoteattr(child)}/>\n"
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "</joint>\n"
    )
