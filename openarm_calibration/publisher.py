# SPDX-License-Identifier: Apache-2.0
"""Node `calibration_publisher`: where the cameras are mounted, on /tf_static.

For each camera: parent → `<camera>_link` (the mount; nominal, as configured) and `<camera>_link` →
`<camera>_color_optical_frame` (the turn of the axes). Nothing else publishes these edges.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tf2_msgs.msg import TFMessage

from openarm_calibration.config import PublisherConfig
from openarm_common.cameras import T_LINK_OPTICAL, load_cameras
from openarm_common.convert import matrix_to_transform
from openarm_common.errors import Code, OpenArmError
from openarm_common.node import QOS_LATCHED, BaseNode, run


class PublisherNode(BaseNode[PublisherConfig]):
    """Publishes the mounts once, latched."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration_publisher", PublisherConfig, **kwargs)
        cameras = load_cameras(Path(self.config.cameras) if self.config.cameras else None)
        links = self.description.links
        message = TFMessage()
        for camera in cameras.values():
            if camera.parent not in links:
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"camera {camera.name!r}: parent {camera.parent!r} is no link of the robot;"
                    f" links: {', '.join(links)}",
                )
            # stamp 0: a fixed edge holds at any time, and this node needs no clock
            message.transforms += [
                matrix_to_transform(camera.parent, camera.link_frame, camera.T_parent_link, 0),
                matrix_to_transform(camera.link_frame, camera.optical_frame, T_LINK_OPTICAL, 0),
            ]
        self._mounts = self.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self._mounts.publish(message)
        self.diagnose(True, f"nominal mounts of {', '.join(cameras)}")


def main() -> None:
    """Run the node."""
    run(PublisherNode)


if __name__ == "__main__":
    main()
