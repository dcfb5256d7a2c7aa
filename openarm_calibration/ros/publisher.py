# SPDX-License-Identifier: Apache-2.0
"""Node `calibration_publisher`: where cameras and table are, on /tf_static; what intrinsics that was found with.

For each camera: parent → `<camera>_link` (the mount) and `<camera>_link` → `<camera>_color_optical_frame` (the turn of
the axes). The mount is the stored calibration of the camera, or, where there is none of these mounts, the nominal one.
A change of the store is published within `period`. Nothing else publishes these edges. Simulated mounts of a seed may
also be calibrated in the store's subfolder `mount_seed_<seed>`, or by what comes with the suite.

/calibration/<camera>/camera_info has the intrinsics of the calibration in use, for whoever compares; it is empty (width
0) where there is no record of them: nominal mounts, files of old.

The frame `table` is as high as the table was measured, or as the scene says; all nodes take the height from it.
/calibration_publisher/save_table stores a measured one.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from openarm_interfaces.srv import SaveTable
from sensor_msgs.msg import CameraInfo
from tf2_msgs.msg import TFMessage

from openarm_calibration.store.store import PublisherConfig, of_these_mounts, places
from openarm_calibration.store.table import TABLE, StoredTable, TableStore
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, CameraConfig, Intrinsics, load_cameras
from openarm_common.config import validate
from openarm_common.errors import Code, OpenArmError
from openarm_common.records import default_folder, now
from openarm_common.robot.zeros import zeros_label
from openarm_common.ros.answers import answering
from openarm_common.ros.convert import info_from_intrinsics, matrix_to_transform
from openarm_common.ros.node import QOS_LATCHED, BaseNode, run
from openarm_common.ros.tf import TABLE_FRAME
from openarm_common.scene.scene import load_scene
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
        self._tables, self._configured = TableStore(folder), load_scene(self.config.scene).table.top_z
        self._seen = self._state()
        self._last: dict[str, tuple[Array, Intrinsics | None]] = {}
        self._infos = {
            camera.name: self.create_publisher(CameraInfo, f"/calibration/{camera.name}/camera_info", QOS_LATCHED)
            for camera in self._cameras.values()
            if camera.depth
        }
        self._mounts = self.create_publisher(TFMessage, "/tf_static", QOS_LATCHED)
        self._publish()
        self.create_timer(self.config.period, self._check, clock=self.steady_clock)
        self.create_service(SaveTable, "~/save_table", answering(self._save_table))

    def _state(self) -> tuple[object, ...]:
        return (*(store.state() for store in self._stores), self._tables.state())

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
            (mount, optics), sources[camera.name] = self._mount(camera, faults)
            if camera.name in self._infos:
                info = CameraInfo() if optics is None else info_from_intrinsics(optics, camera.optical_frame, 0)
                self._infos[camera.name].publish(info)
            # stamp 0: a fixed edge holds at any time, and this node needs no clock
            message.transforms += [
                matrix_to_transform(camera.parent, camera.link_frame, mount, 0),
                matrix_to_transform(camera.link_frame, camera.optical_frame, T_LINK_OPTICAL, 0),
            ]
        height, sources[TABLE] = self._table(faults)
        message.transforms.append(
            matrix_to_transform(self.description.base, TABLE_FRAME, se3.make(None, (0.0, 0.0, height)), 0)
        )
        self._mounts.publish(message)
        for fault in faults:
            self.get_logger().warning(fault)
        text = ", ".join(f"{name} {source}" for name, source in sources.items())
        self.get_logger().info(f"in use: {text}")
        self.diagnose(not faults, "; ".join(faults) or f"in use: {text}", **sources)

    def _table(self, faults: list[str]) -> tuple[float, str]:
        """Return the height of the table, base frame, m, and where it is from; a damaged file is a fault."""
        if self.config.nominal:
            return self._configured, f"{self._configured:.4f} m, nominal, as asked"
        height, source, fault = self._tables.in_use(self._configured, self.config.seed)
        faults += [fault] if fault else []
        return height, f"{height:.4f} m, {source}"

    def _save_table(self, request: SaveTable.Request, response: SaveTable.Response) -> str:
        before, _, _ = self._tables.in_use(self._configured, self.config.seed)
        said = {"height": request.height, "std": request.std, "tilt": request.tilt, "method": request.method}
        known = {"configured": self._configured, "mount_seed": self.config.seed, "created": now()}
        measured = validate(StoredTable, said | known, "table", Code.INVALID_ARGUMENT)
        response.path = str(self._tables.save_level(measured))
        self._check()
        note = "; but the parameter `nominal` keeps that of the scene in use" if self.config.nominal else ""
        return f"the table is {request.height:.4f} m high, before {before:.4f} m; stored in {response.path}{note}"

    def _mount(self, camera: CameraConfig, faults: list[str]) -> tuple[tuple[Array, Intrinsics | None], str]:
        """Return mount and intrinsics of a camera and where they are from; a stored one that can't be used is a fault.

        The intrinsics are None where there is no record of them.
        """
        if self.config.nominal:
            return (camera.T_parent_link, None), "nominal, as asked"
        if camera.left:
            (mount, optics), source = self._mount(self._cameras[camera.left], [])
            return (mount @ camera.T_left_link, optics), f"with {camera.left}: {source}"
        seed = self.config.seed if camera.mount_error else None
        found, reasons = of_these_mounts(self._stores, camera.name, camera.parent, seed)
        if found is None:
            faults += reasons
            if camera.name in self._last:
                return self._last[camera.name], "calibrated, the file before"
            return (camera.T_parent_link, None), "nominal"
        if reasons:  # a calibration of other mounts next to the right one is no fault
            self.get_logger().info("; ".join(reasons))
        if found.warning:
            faults.append(found.warning)
        calibration = found.record
        if calibration.zeros != zeros_label(self.description.zeros):
            faults.append(
                f"the calibration of {camera.name!r} was found with other zeros of the joints than those in use;"
                " calibrate it again, or start the graph again where zeros were stored since"
            )
        self._last[camera.name] = calibration.T_parent_link, calibration.intrinsics
        return self._last[camera.name], f"calibrated {calibration.digest()[:12]}"


def main() -> None:
    """Run the node."""
    run(PublisherNode)


if __name__ == "__main__":
    main()
