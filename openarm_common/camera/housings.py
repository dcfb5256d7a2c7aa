# SPDX-License-Identifier: Apache-2.0
"""Camera bodies as part of the robot: what carries a camera also collides with it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from types import MappingProxyType

from openarm_common.camera.cameras import CameraConfig
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import Primitive, RobotDescription


def with_housings(description: RobotDescription, cameras: Iterable[CameraConfig]) -> RobotDescription:
    """Return the description with each camera's housing, at its nominal mount, among its parent's collision shapes.

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
