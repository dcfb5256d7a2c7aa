# SPDX-License-Identifier: Apache-2.0
"""What is kept of a task that did not go as expected: pictures, cloud and map, joints, states, how to run it again."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from openarm_common.camera.cameras import spectator_camera, table_camera
from openarm_common.errors import OpenArmError
from openarm_common.octree.codec import write_file
from openarm_evaluation.campaign.robot import SimRobot
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import DepthScan, OccupancyGrid

_PICTURES = 6


def write_reason(folder: Path, row: Mapping[str, Any]) -> None:
    """Write the row of a task, and for people why it failed and how to run it again."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "row.json").write_text(json.dumps(row, indent=1, default=str), encoding="utf-8")
    truth = "; ".join(row["reasons"]) or "as asked"
    text = f"{row['outcome']}: {row['code']}: {row['message']}\nground truth: {truth}\nagain: {row['again']}\n"
    (folder / "reason.txt").write_text(text, encoding="utf-8")


class Keeper:
    """Collects while a task runs; writes nothing unless it is asked to.

    Args:
        robot: Robot that the task runs on.
        folder: Folder of this task.
    """

    def __init__(self, robot: SimRobot, folder: Path) -> None:
        self._robot = robot
        self._folder = folder
        self._pictures: list[tuple[str, NDArray[np.uint8]]] = []
        self._scan: DepthScan | None = None
        self._failed = False
        #: Cameras that take the pictures: over the table, and for people.
        self._views = tuple(dict.fromkeys((table_camera(), spectator_camera())))

    def step(self, state: str, *, failed: bool) -> None:
        """Note a transition; the first one after a failure is photographed."""
        if failed and not self._failed and len(self._pictures) < _PICTURES:
            self._shoot(f"failed_{len(self._pictures) // len(self._views)}_{state.lower()}")
        self._failed = failed
        seen = self._robot.images.get(table_camera())
        if state == "TRANSFORM" and seen is not None:
            t_ns, _, depth = seen
            camera = self._robot.cameras[table_camera()]
            T_base_camera = self._robot.camera_pose(camera, t_ns)
            self._scan = DepthScan(depth.copy(), camera.intrinsics, T_base_camera, camera.near, camera.far)

    def write(self, row: Mapping[str, Any], steps: Sequence[Mapping[str, Any]]) -> Path:
        """Write all that is known of the task into its folder, and return that."""
        folder = self._folder
        folder.mkdir(parents=True, exist_ok=True)
        self._shoot("end")
        for name, picture in self._pictures:
            cv2.imwrite(str(folder / f"{name}.png"), np.ascontiguousarray(picture[..., ::-1]))
        if self._scan is not None:
            np.savez_compressed(folder / "cloud.npz", points_base=self._scan.points())
            grid = OccupancyGrid(GridConfig())
            grid.integrate([self._scan], 0)
            write_file(folder / "map.bt", grid.binary(), grid.lattice.resolution, self._robot.description.name)
        t_ns, position, effort = map(np.array, zip(*self._robot.trace, strict=True))
        names = np.array(self._robot.world.joint_names)
        np.savez_compressed(folder / "joints.npz", joint_names=names, t_ns=t_ns, position=position, effort=effort)
        write_reason(folder, {**row, "transitions": list(steps)})
        return folder

    def _shoot(self, name: str) -> None:
        for view in self._views:
            try:
                self._pictures.append((f"{name}_{view}", self._robot.draw(view)[0].copy()))
            except OpenArmError:
                return  # a picture that cannot be drawn is not what failed
