# SPDX-License-Identifier: Apache-2.0
"""Camera bodies as part of the robot: what carries a camera also collides with it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from types import MappingProxyType

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive, RobotDescription
from openarm_common.types import Array


def mounted(cameras: Mapping[str, CameraConfig], mounts: Mapping[str, Array]) -> dict[str, CameraConfig]:
    """Return the cameras, by name, at calibrated mounts.

    Args:
        cameras: Cameras by name.
        mounts: T_parent_link (4, 4) by camera; those left out stay where they are.
    """
    moved = dict(cameras)
    for name, T in mounts.items():
        pose = {"position": T[:3, 3].tolist(), "forward": T[:3, 0].tolist(), "image_right": (-T[:3, 1]).tolist()}
        moved[name] = cameras[name].model_copy(update={key: tuple(value) for key, value in pose.items()})
    return moved


def with_housings(description: RobotDescription, cameras: Iterable[CameraConfig]) -> RobotDescription:
    """Return the description with each camera's housing, at its mount, among its parent's collision shapes.

    The URDF text is left as it is: a housing belongs to a mount, and mounts are not part of the robot.

    Raises:
        OpenArmError: CONFIG_INVALID, when a camera with a housing hangs on a link that the robot does not have.
    """
    links = dict(description.links)
    for camera in cameras:
        if camera.housing is None:
            continue
        if camera.parent not in links:
            raise OpenArmError(
                Code.CONFIG_INVALID,
                f"camera {camera.name!r}: no link {camera.parent!r} to mount it on; links: {', '.join(links)}",
            )
        link = links[camera.parent]
        pose = camera.T_parent_link @ camera.T_link_housing
        shape = Primitive(f"{camera.name}_housing", "box", camera.housing, pose)
        links[camera.parent] = replace(link, collision=(*link.collision, shape))
    return replace(description, links=MappingProxyType(links))
