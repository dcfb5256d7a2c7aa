# SPDX-License-Identifier: Apache-2.0
"""The map that the suite's own cameras and mapper make of boxes on the table, for planning problems. Base frame, m."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.map_scene import MapScene
from openarm_common.robot.folder import robot_work
from openarm_common.scene.scene import PALETTE, Scene, SceneObject
from openarm_motion.collision.occupancy import Environment, OccupancyMap
from openarm_motion.collision.solids import Box
from openarm_motion.config import MapConfig
from openarm_motion.planning.arm import Arm
from openarm_motion.scene.map_view import unexplained
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
from openarm_octomap.kernels import OCCUPIED
from openarm_octomap.mapper import Mapper

#: Frames of each camera that go into a map, with the noise of its depths.
_FRAMES = 2


def rendered(arm: Arm, home: Mapping[str, float], boxes: Sequence[Box], seed: int) -> Environment:
    """The octree of both cameras' images of the table and the boxes, less what is known: the table and the robot.

    Args:
        arm: One of the arms; its fixed bodies are known.
        home: Joints of the robot while the cameras look.
        boxes: What stands on the table; they are known through the map alone.
        seed: Seed of the noise.
    """
    colours = list(PALETTE)
    objects = tuple(
        SceneObject(
            name=box.id,
            shape="box",
            size=tuple(box.size.tolist()),
            color=colours[i % len(colours)],
            position=tuple(box.T[:3, 3].tolist()),
        )
        for i, box in enumerate(boxes)
    )
    place = MapScene(Scene(name="bench", table=robot_work().table, objects=objects))
    try:
        place.joints = dict(home)
        mapper = Mapper(place.body, GridConfig(), FilterConfig(), FieldConfig())
        rng = np.random.default_rng(seed)
        for k in range(_FRAMES):
            mapper.update(place.frames(k * 33_000_000, rng))
        states = mapper.snapshot(("states",)).states
    finally:
        place.close()
    if states is None:
        raise RuntimeError("the mapper gave no states")
    seen = OccupancyMap(np.argwhere(states == OCCUPIED), mapper.lattice, 1)
    return Environment(map=unexplained(seen, MapConfig(), arm.description, home, arm.static, ()))
