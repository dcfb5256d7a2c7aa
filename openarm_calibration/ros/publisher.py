# SPDX-License-Identifier: Apache-2.0
"""Node `calibration_publisher`: where the cameras are mounted, on /tf_static.

For each camera: parent → `<camera>_link` (the mount) and `<camera>_link` → `<camera>_color_optical_frame` (the turn of
the axes). The mount is the stored calibration of the camera, or, where there is none of these mounts, the nominal one.
A change of the store is published within `period`. Nothing else publishes these edges. Simulated mounts of a seed may
also be calibrated in the store's subfolder `mount_seed_<seed>`, or by what comes with the suite.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tf2_msgs.msg import TFMessage

from openarm_calibration.store.store import PublisherConfig, default_folder, of_these_mounts, places
from openarm_common.camera.cameras import T_LINK_OPTICAL, CameraConfig, load_cameras
from openarm_common.errors import Code, OpenArmError
from openarm_common.ros.convert import matrix_to_transform
from openarm_common.ros.node import QOS_LATCHED, BaseNode, run
from openarm_common.types import Array


class PublisherNode(BaseNode[PublisherConfig]):
    """Publishes the mounts, latched, and again when the store changes."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("calibration_publisher", PublisherConfig, **kwargs)
        self._cameras = load_cameras(Path(self.config.cameras) if self.config.cameras else None)
        links = self.description.links
        for camera in self._cameras.values():
            if camera.parent not in links:
                raise OpenArmError(
                    Code.CONFIG_INVALID,
                    f"camera {camera.name!r}: parent {camera.parent!r} is no link of the robot;"
                    f" links: {', '.join(links)}",
                )
        folder = Path(self.config.store) if self.config.store else default_folder()
        self._stores = places(folder, self.config.seed)
        self._seen = self._state()
        self._last: dict[str, Array] = {}
        self._mounts = self.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self._publish()
        self.create_timer(self.config.period, self._check, clock=self.steady_clock)

    def _state(self) -> tuple[object, ...]:
        return tuple(store.state() for store in self._stores)

    def _check(self) -> None:
        state = self._state()
        if state != self._seen:
            self._seen = state
            self._publish()

    def _publish(self) -> None:
        message = TFMessage()
        sources: dict[str, str] = {}
        faults: list[str] = []
        for camera in self._cameras.values():
            mount, sources[camera.name] = self._mount(camera, faults)
            # stamp 0: a fixed edge holds at any time, and this node needs no clock
            message.transforms += [
                matrix_to_transform(camera.parent, camera.link_frame, mount, 0),
                matrix_to_transform(camera.link_frame, camera.optical_frame, T_LINK_OPTICAL, 0),
            ]
        self._mounts.publish(message)
        for fault in faults:
            self.get_logger().warning(fault)
        text = ", ".join(f"{name} {source}" for name, source in sources.items())
        self.get_logger().info(f"mounts: {text}")
        self.diagnose(not faults, "; ".join(faults) or f"mounts: {text}", **sources)

    def _mount(self, camera: CameraConfig, faults: list[str]) -> tuple[Array, str]:
        """Return the mount of a camera and where it is from; a stored one that can't be used is a fault."""
        if self.config.nominal:
            return camera.T_parent_link, "nominal, as asked"
        seed = self.config.seed if camera.mount_error else None
        found, reasons = of_these_mounts(self._stores, camera.name, camera.parent, seed)
        if found is None:
            faults += reasons
            if camera.name in self._last:
                return self._last[camera.name], "calibrated, the file before"
            return camera.T_parent_link, "nominal"
        if reasons:  # a calibration of other mounts next to the right one is no fault
            self.get_logger().info("; ".join(reasons))
        if found.warning:
            faults.append(found.warning)
        calibration = found.calibration
        self._last[camera.name] = calibration.T_parent_link
        return calibration.T_parent_link, f"calibrated {calibration.digest()[:12]}"


def main() -> None:
    """Run the node."""
    run(PublisherNode)


if __name__ == "__main__":
    main()
