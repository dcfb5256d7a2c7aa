# SPDX-License-Identifier: Apache-2.0
"""A table seen by a camera, rendered by MuJoCo: the ground truth of the perception tests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.localization import Studio
from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig
from openarm_perception.detection.pipeline import Perceived, Pipeline
from openarm_perception.geometry.depth import DepthLimits

TABLE = 0.40
RGBA = {
    "red": (0.80, 0.10, 0.10),
    "orange": (0.95, 0.45, 0.05),
    "yellow": (0.92, 0.78, 0.08),
    "green": (0.12, 0.60, 0.20),
    "blue": (0.10, 0.25, 0.80),
    "purple": (0.50, 0.15, 0.65),
    "grey": (0.50, 0.50, 0.50),
}

_XML = """
<mujoco>
  <visual>
    <global offwidth="640" offheight="480"/><quality offsamples="0" shadowsize="0"/><map znear="0.02" zfar="5"/>
  </visual>
  <worldbody>
    <light pos="1.5 0 2.5" dir="-0.5 0 -0.8" directional="true" castshadow="false"
           diffuse="0.6 0.6 0.6" ambient="0.3 0.3 0.3"/>
    <geom name="table" type="box" size="0.5 0.8 0.02" pos="0.4 0 0.38" rgba="0.72 0.70 0.67 1"/>
    <geom name="floor" type="plane" size="3 3 0.1" rgba="0.4 0.4 0.42 1"/>
    <body name="camera" mocap="true"><camera name="camera" fovy="60"/></body>
    {bodies}
  </worldbody>
</mujoco>
"""
_BODY = '<body name="o{i}" mocap="true"><geom name="o{i}" type="{kind}" size="0.02 0.02 0.02"/></body>'


@dataclass(frozen=True)
class Thing:
    """On the table: a box (edges x, y, z) or an upright cylinder (diameter, diameter, height), m and rad."""

    label: str
    kind: str
    size: tuple[float, float, float]
    x: float
    y: float
    yaw: float = 0.0
    lying: bool = False  # a cylinder with its axis along the yaw

    @property
    def position(self) -> NDArray[np.float64]:
        """Middle of the object, base frame, m."""
        return np.array([self.x, self.y, TABLE + self.size[0 if self.lying else 2] / 2.0])


@dataclass(frozen=True)
class View:
    """What the camera saw."""

    rgb: NDArray[np.uint8]
    depth: NDArray[np.float32]  # m
    intrinsics: Intrinsics
    T_base_camera: NDArray[np.float64]

    @property
    def millimetres(self) -> NDArray[np.uint16]:
        """The depth as a 16UC1 image."""
        return np.round(self.depth * 1e3).astype(np.uint16)

    def perceived(self, pipeline: Pipeline) -> Perceived:
        """What a pipeline finds in it."""
        return pipeline.run(self.rgb, self.depth, self.intrinsics, self.T_base_camera)


def look_at(position: Sequence[float], target: Sequence[float], right: Sequence[float]) -> NDArray[np.float64]:
    """T_base_camera of an optical frame (z forward, x right)."""
    forward = np.subtract(target, position)
    return se3.make(se3.rotation_from_z_y(forward, np.cross(forward, right)), position)


OVERHEAD = look_at((0.55, 0.0, 1.10), (0.27, 0.0, 0.42), (0.0, 1.0, 0.0))


class Tabletop:
    """Renders up to four boxes and four cylinders on a table.

    Tests reach the names of this module through it, because a conftest can't be imported.
    """

    Thing = Thing
    look_at = staticmethod(look_at)
    table_height = TABLE
    labels = tuple(label for label in RGBA if label != "grey")  # those that the colour detector knows

    def __init__(self) -> None:
        kinds = ["box"] * 4 + ["cylinder"] * 4
        bodies = "".join(_BODY.format(i=i, kind=kind) for i, kind in enumerate(kinds))
        self._model = mujoco.MjModel.from_xml_string(_XML.format(bodies=bodies))
        self._data = mujoco.MjData(self._model)
        self._renderer = mujoco.Renderer(self._model, 480, 640)

    def render(self, things: Sequence[Thing], T_base_camera: NDArray[np.float64] = OVERHEAD) -> View:
        """Colour and depth of the things as the camera sees them."""
        model, data = self._model, self._data
        data.mocap_pos[:] = (0.0, 0.0, -5.0)
        free = {"box": [1, 2, 3, 4], "cylinder": [5, 6, 7, 8]}
        for thing in things:
            slot = free[thing.kind].pop(0)
            half = np.array(thing.size) / 2.0
            geom = model.geom(f"o{slot - 1}").id
            model.geom_size[geom] = half if thing.kind == "box" else (half[0], half[2], 0.0)
            model.geom_rgba[geom] = (*RGBA[thing.label], 1.0)
            data.mocap_pos[slot] = thing.position
            R = se3.rot_z(thing.yaw) @ (se3.rot_y(np.pi / 2) if thing.lying else np.eye(3))
            data.mocap_quat[slot] = np.roll(se3.quat_xyzw_from_matrix(R), 1)
        # MuJoCo's cameras look along -z with y up
        R = T_base_camera[:3, :3] @ np.diag([1.0, -1.0, -1.0])
        data.mocap_pos[0], data.mocap_quat[0] = T_base_camera[:3, 3], np.roll(se3.quat_xyzw_from_matrix(R), 1)
        mujoco.mj_forward(model, data)
        self._renderer.update_scene(data, "camera")
        rgb = self._renderer.render()
        self._renderer.enable_depth_rendering()
        depth = self._renderer.render()
        self._renderer.disable_depth_rendering()
        return View(rgb, depth, Intrinsics.from_fovy(640, 480, 60.0), T_base_camera)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


@pytest.fixture(scope="session")
def tabletop() -> Iterator[Tabletop]:
    """A renderer for all tests of the package."""
    scene = Tabletop()
    yield scene
    scene.close()


@pytest.fixture(scope="module")
def detector() -> ColorDetector:
    """The detector as the suite configures it."""
    return ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))


@pytest.fixture(scope="module")
def pipeline(detector: ColorDetector) -> Pipeline:
    """Detector and localiser with their defaults."""
    return Pipeline(detector, Localizer(LocalizerConfig(), DepthLimits(near=0.07), TABLE))


@pytest.fixture(scope="module")
def studio() -> Iterator[Studio]:
    """Robot, scenes and cameras."""
    made = Studio()
    yield made
    made.close()
