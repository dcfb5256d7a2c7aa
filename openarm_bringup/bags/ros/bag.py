# SPDX-License-Identifier: Apache-2.0
"""Perception, map and board detection on the messages of a bag, without a graph: the same numbers at every run.

Frames are worked on in the order of their stamps, with the joint states and static transforms of the bag, by the same
cores that the nodes run.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from sensor_msgs.msg import CameraInfo

from openarm_bringup.bags.bag import Bag
from openarm_bringup.bags.ros.messages import contents, messages_of
from openarm_calibration.board.board import CircleGrid
from openarm_calibration.board.detect import detect
from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.config import load_config
from openarm_common.errors import Code, OpenArmError
from openarm_common.resources import config_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.robot_state import RobotStateBuffer
from openarm_common.ros.convert import stamp_to_ns, transform_to_matrix
from openarm_common.ros.images import AnyImage, color_of, depth_of, grey_image, is_rectified, lens_from_info
from openarm_common.ros.tf import table_height
from openarm_common.scene.scene import load_scene
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
from openarm_octomap.grid import DepthScan
from openarm_octomap.mapper import Frame, Mapper
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig, LocatedObject
from openarm_perception.detection.pipeline import Pipeline
from openarm_perception.geometry.depth import DepthLimits
from openarm_perception.ros.frames import camera_topics

#: Boards are searched for twice a second in each camera: it is held still for as long, and the search is slow.
_BOARD_PERIOD_NS = 500_000_000


@dataclass
class _Shot:
    """The messages of one stamp of one camera."""

    camera: CameraConfig
    t_ns: int
    rectified: bool
    color: AnyImage | None = None
    depth: AnyImage | None = None
    info: CameraInfo | None = None


@dataclass
class _Found:
    """Results of the frames."""

    frames: int = 0
    skipped: int = 0
    objects: dict[str, list[LocatedObject]] = field(default_factory=lambda: defaultdict[str, list[LocatedObject]](list))
    boards: dict[str, list[float]] = field(default_factory=lambda: defaultdict[str, list[float]](list))


def numbers_of(
    bag: Bag,
    *,
    scene: str = "demo",
    on_progress: Callable[[int, int], None] = lambda done, of: None,
) -> dict[str, float]:
    """Run detection, localisation, map and board detection on a bag.

    Args:
        bag: Open; with colour and depth of a camera of the suite, /joint_states and /tf_static.
        scene: Scene whose table the objects stand on, for a bag without the frame `table`.
        on_progress: Called with the number of frames done, and of all.

    Returns:
        By name: frames used and skipped, of each label how often it was found, where last (base frame), how far from
        where it was found first, and its mean size; cells of the map by state; frames with a board and its residual.

    Raises:
        OpenArmError: NOTHING_DETECTED, when the bag has no frame that could be used.
    """
    description = RobotDescription.load()
    with contents(bag):
        shots, states = _read(bag, description)
    detector = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))
    said = [height for message in messages_of(bag, ["/tf_static"])["/tf_static"] if (height := table_height(message))]
    table = said[-1] if said else load_scene(scene).table.top_z
    mapper = Mapper(description, GridConfig(), FilterConfig(), FieldConfig())
    found = _Found()
    searched_ns: dict[str, int] = {}
    for number, shot in enumerate(shots):
        on_progress(number, len(shots))
        limits = DepthLimits(near=shot.camera.near, far=shot.camera.far)
        pipeline = Pipeline(detector, Localizer(LocalizerConfig(), limits, table))
        try:
            _work(shot, states, pipeline, mapper, found)
        except OpenArmError:
            found.skipped += 1
        if shot.t_ns - searched_ns.get(shot.camera.name, shot.t_ns - _BOARD_PERIOD_NS) >= _BOARD_PERIOD_NS:
            searched_ns[shot.camera.name] = shot.t_ns
            _detect_board(shot, found)
    on_progress(len(shots), len(shots))
    if not found.frames:
        raise OpenArmError(
            Code.NOTHING_DETECTED,
            f"{bag.path} has no frame with colour, depth, camera_info, joint states and transforms; topics: "
            f"{', '.join(sorted(bag.topics)) or 'none'}",
        )
    return _numbers(found, mapper, shots[-1].t_ns)


def _read(bag: Bag, description: RobotDescription) -> tuple[list[_Shot], RobotStateBuffer]:
    cameras = {name: camera for name, camera in load_cameras().items() if camera.depth}
    kinds = {topic: kind for topic, (kind, _) in bag.topics.items()}
    topics: dict[str, tuple[str, str]] = {}
    for name in cameras:
        with suppress(OpenArmError):  # the bag has no such camera
            mine = {topic: kind for topic, kind in kinds.items() if topic.startswith(f"/{name}/")}
            chosen = camera_topics(mine, known=True)  # by either CameraInfo: they are one in this suite
            info = chosen.depth_info or chosen.info
            topics |= {chosen.color: (name, "color"), chosen.depth: (name, "depth"), info: (name, "info")}
    found = messages_of(bag, [*topics, "/joint_states", "/tf_static"])
    states = RobotStateBuffer(description, capacity=max(len(found["/joint_states"]), 1))
    for message in found["/tf_static"]:
        for edge in message.transforms:
            states.set_static(edge.header.frame_id, edge.child_frame_id, transform_to_matrix(edge.transform))
    for message in sorted(found["/joint_states"], key=_stamp):
        states.add_joint_state(_stamp(message), message.name, message.position, message.velocity)
    rectified = {name: is_rectified(topic) for topic, (name, part) in topics.items() if part == "color"}
    shots: dict[tuple[int, str], _Shot] = {}
    for topic, (name, part) in topics.items():
        for message in found[topic]:
            t_ns = _stamp(message)
            setattr(shots.setdefault((t_ns, name), _Shot(cameras[name], t_ns, rectified[name])), part, message)
    return [shots[key] for key in sorted(shots)], states


def _stamp(message: Any) -> int:
    return stamp_to_ns(message.header.stamp)


def _work(shot: _Shot, states: RobotStateBuffer, pipeline: Pipeline, mapper: Mapper, found: _Found) -> None:
    if shot.depth is None or shot.color is None or shot.info is None:
        raise OpenArmError(Code.BAD_IMAGE, "colour, depth or camera_info of a stamp is missing")
    T_base_camera = states.lookup(RobotDescription.load().base, shot.camera.optical_frame, shot.t_ns)
    joints = states.joints_at(shot.t_ns)
    lens = lens_from_info(shot.info, rectified=shot.rectified)
    rgb, depth = color_of(shot.color, lens), depth_of(shot.depth, lens)
    for located in pipeline.run(rgb, depth, lens.intrinsics, T_base_camera).located:
        found.objects[f"{shot.camera.name}/{located.label}"].append(located)
    scan = DepthScan(depth, lens.intrinsics, T_base_camera, shot.camera.near, shot.camera.far)
    mapper.update([Frame(shot.camera.name, shot.t_ns, scan, joints)])
    found.frames += 1


def _detect_board(shot: _Shot, found: _Found) -> None:
    if shot.color is None:
        return
    try:
        residual = detect(CircleGrid(), grey_image(shot.color)).residual
    except OpenArmError:
        return  # most frames show none
    found.boards[shot.camera.name].append(residual)


def _numbers(found: _Found, mapper: Mapper, t_ns: int) -> dict[str, float]:
    numbers: dict[str, float] = {"frames": found.frames, "frames_skipped": found.skipped}
    for label, located in found.objects.items():
        numbers[f"detection/{label}/frames"] = len(located)
        first, last = (located[i].T_base_object[:3, 3] * 1e3 for i in (0, -1))
        size = np.mean([one.size for one in located], axis=0) * 1e3
        numbers[f"detection/{label}/moved_mm"] = round(float(np.linalg.norm(last - first)), 3)
        for axis, at, extent in zip("xyz", last, size, strict=True):
            numbers[f"detection/{label}/{axis}_mm"] = round(float(at), 3)
            numbers[f"detection/{label}/size_{axis}_mm"] = round(float(extent), 3)
    for state, count in mapper.counts(t_ns).items():
        if state != "oldest_s":
            numbers[f"map/{state}"] = count
    for camera, residuals in found.boards.items():
        numbers[f"board/{camera}/frames"] = len(residuals)
        numbers[f"board/{camera}/residual_px"] = round(float(np.sqrt(np.mean(np.square(residuals)))), 4)
    return numbers
