# SPDX-License-Identifier: Apache-2.0
"""Where the detector says that objects are, compared with where they are: both cameras, clean and noisy depth.

    python benchmarks/localization.py [--quick] [--poses N] [--first-seed S] [--json PATH]

Every pose is a random object (cube, box, cylinder or can, 4 to 7 cm wide) at a random place and yaw on the table, drawn
from a seed of its own. The overhead camera looks past the robot at home; the wrist camera looks from a posture within

SIDES = RobotDescription.load().arm_names
0.06 rad of `wrist_look`, at objects that are in its picture. Images are 640 x 480, 16UC1; noisy depth is that of a
D435 (`openarm_sim_bridge.cameras.noise`: error growing with the square of the depth, flying pixels, holes).

    CAMERA_DEPTH_position_p50_mm, ..._p95_mm, ..._max_mm   middle of the object; peer: the depth of the box's middle,
                                                           as tutorials do it, its horizontal error alone
    CAMERA_DEPTH_yaw_p50_deg, ..._p95_deg, ..._max_deg     of what is no cylinder
    CAMERA_DEPTH_size_p95_mm                               the worst of the three edges
    CAMERA_DEPTH_refused                                   objects that were refused by name before N were located,
                                                           such as those that a finger hides
"""

from __future__ import annotations

import argparse
import math
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_common import se3
from openarm_common.camera.cameras import CameraConfig, load_cameras
from openarm_common.config import load_config
from openarm_common.resources import config_dir
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.work import Table
from openarm_common.scene.scene import Scene, SceneObject, random_scene
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig
from openarm_perception.detection.localize import Localizer, LocalizerConfig, LocatedObject
from openarm_perception.detection.pipeline import Perceived, Pipeline
from openarm_perception.geometry.depth import DepthLimits
from openarm_sim_bridge.cameras.noise import DepthNoiseConfig, add_depth_noise
from openarm_sim_bridge.cameras.renderer import SnapshotRenderer
from openarm_sim_bridge.world.model import compile_model
from openarm_sim_bridge.world.world import Snapshot

#: Largest turn of each joint away from the observation posture, rad.
_JITTER = 0.06
#: Pixels between an object and the border of the picture.
_BORDER = 12


class Studio:
    """Robot, scenes and cameras, without physics and without ROS."""

    def __init__(self) -> None:
        self.description = RobotDescription.load()
        self.cameras: dict[str, CameraConfig] = load_cameras()
        self.detector = ColorDetector(load_config(config_dir() / "params" / "detector.yaml", ColorDetectorConfig))
        self._renderer = SnapshotRenderer(self.cameras)

    def home(self) -> dict[str, float]:
        """Joint positions of the home posture, grippers open."""
        opening = {self.description.finger_joint(side): 0.044 for side in self.description.arm_names}
        return self.description.group_state("both_arms", "home") | opening

    def looking(self, rng: np.random.Generator | None = None) -> dict[str, float]:
        """Home, but the right hand holds its camera over the table; a little elsewhere when there is a generator."""
        posture = self.description.group_state("right_arm", "wrist_look")
        arm = {name: posture[name] for name in self.description.arm_joints("right")}
        if rng is not None:
            arm = {name: q + float(rng.uniform(-_JITTER, _JITTER)) for name, q in arm.items()}
        return self.home() | arm

    def T_base_camera(self, camera: str, joints: Mapping[str, float]) -> NDArray[np.float64]:
        """Optical frame of a camera."""
        config = self.cameras[camera]
        return self.description.link_pose(config.parent, joints) @ config.T_parent_optical

    def shows(self, camera: str, joints: Mapping[str, float], item: SceneObject, table: Table) -> bool:
        """Whether the picture of a camera has room for an object, were nothing before it."""
        width, depth, height = item.size
        corners = np.array([(x, y, z) for x in (-width, width) for y in (-depth, depth) for z in (-height, height)]) / 2
        local = se3.make(se3.rot_z(item.yaw), item.centre(table))
        config = self.cameras[camera]
        pixels = config.intrinsics.project(
            se3.apply(se3.inverse(self.T_base_camera(camera, joints)), se3.apply(local, corners))
        )
        size = np.array([config.width, config.height])
        return bool(np.isfinite(pixels).all() and (pixels > _BORDER).all() and (pixels < size - 1 - _BORDER).all())

    def load(self, scene: Scene, joints: Mapping[str, float]) -> None:
        """Put robot and objects where they are looked at."""
        model = compile_model(self.description, scene, self.cameras)
        data = mujoco.MjData(model)
        for name, joint in self.description.joints.items():
            leader = joint.mimic or name
            if leader in joints:
                data.qpos[model.joint(name).qposadr[0]] = joints[leader]
        self._renderer.load(Snapshot(model, 0, data.qpos.copy()))

    def draw(
        self, camera: str, noise: np.random.Generator | None = None
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint16]]:
        """Colour and 16UC1 depth of what was loaded; the depth is noisy when there is a generator."""
        config = self.cameras[camera]
        rgb = np.empty((config.height, config.width, 3), np.uint8)
        depth = np.empty((config.height, config.width), np.uint16)

        def spoil(_: str, z: NDArray[np.float32]) -> NDArray[np.float32]:
            return z if noise is None else add_depth_noise(z, config.intrinsics.fy, DepthNoiseConfig(), noise)

        self._renderer.draw(camera, rgb, depth, spoil)
        return rgb, depth

    def pipeline(self, camera: str, table: Table) -> Pipeline:
        """What the detector does with the images of a camera."""
        config = self.cameras[camera]
        limits = DepthLimits(near=config.near, far=config.far)
        return Pipeline(self.detector, Localizer(LocalizerConfig(), limits, table.top_z))

    def perceive(
        self, scene: Scene, joints: Mapping[str, float], camera: str, noise: np.random.Generator | None = None
    ) -> Perceived:
        """Draw a scene and find its objects."""
        self.load(scene, joints)
        images = self.draw(camera, noise)
        pose = self.T_base_camera(camera, joints)
        return self.pipeline(camera, scene.table).run(*images, self.cameras[camera].intrinsics, pose)

    def close(self) -> None:
        """Free the renderer."""
        self._renderer.close()


def errors(place: LocatedObject, item: SceneObject, table: Table) -> tuple[float, float, float]:
    """Errors of position and size, mm, and of the yaw, degrees; the yaw of a cylinder is never wrong."""
    position = float(np.linalg.norm(place.p_base - item.centre(table))) * 1e3
    size = float(np.abs(np.array(place.size) - (*sorted(item.size[:2]), item.size[2])).max()) * 1e3
    if item.shape == "cylinder":
        return position, size, 0.0
    width, depth, _ = item.size
    expected = item.yaw if width <= depth else item.yaw + math.pi / 2
    period = math.pi / 2 if abs(width - depth) < 0.002 else math.pi
    return position, size, abs(math.degrees((place.yaw - expected + period / 2) % period - period / 2))


def middle_pixel_error(
    perceived: Perceived, depth: NDArray[np.uint16], camera: CameraConfig, T: NDArray[np.float64], truth: NDArray
) -> float:
    """As tutorials do it: the depth of the pixel in the middle of the box. Horizontal error alone, mm."""
    u, v = (round(value) for value in perceived.found[0].centre)
    point = se3.apply(T, camera.intrinsics.deproject((u, v), depth[v, u] * 1e-3))
    return float(np.linalg.norm(point[:2] - truth[:2])) * 1e3


def measure(studio: Studio, camera: str, noisy: bool, poses: int, first_seed: int) -> list[Row]:
    """Locate `poses` objects with one camera."""
    found: list[tuple[float, float, float]] = []
    peer: list[float] = []
    boxes: list[float] = []
    refused: Counter[str] = Counter()
    seed, done = first_seed, 0
    while len(found) < poses and done < 2 * poses:
        scene, rng = random_scene(seed, count=1), np.random.default_rng(seed)
        seed += 1
        item = scene.objects[0]
        joints = studio.looking(rng) if camera == "wrist" else studio.home()
        if not studio.shows(camera, joints, item, scene.table):
            continue
        done += 1
        studio.load(scene, joints)
        rgb, depth = studio.draw(camera, rng if noisy else None)
        T = studio.T_base_camera(camera, joints)
        perceived = studio.pipeline(camera, scene.table).run(rgb, depth, studio.cameras[camera].intrinsics, T)
        mine = [place for place in perceived.located if place.label == item.label]
        if not mine:
            refused[perceived.refused[0].partition(": ")[2] if perceived.refused else "not seen"] += 1
            continue
        error = errors(mine[0], item, scene.table)
        found.append(error)
        boxes += [error[2]] if item.shape == "box" else []
        truth = np.array(item.centre(scene.table))
        peer.append(middle_pixel_error(perceived, depth, studio.cameras[camera], T, truth))
    for reason, count in refused.most_common():
        print(f"  {camera}: {count} x {reason}")
    position, size, _ = np.array(found).T
    yaw, other, name = np.array(boxes), np.array(peer), f"{camera}_{'noisy' if noisy else 'clean'}"

    def row(what: str, values: NDArray, share: float, unit: str, target: float | None, rival: float | None) -> Row:
        rank = "max" if share == 100.0 else f"p{share:g}"
        label = "box's middle pixel" if rival is not None else ""
        value = float(np.percentile(values, share))
        return Row(f"{name}_{what}_{rank}_{unit}", value, unit, "lower", target, label, rival, len(values))

    rows = [
        row("position", position, share, "mm", target, float(np.percentile(other, share)))
        for share, target in ((50.0, None), (95.0, 5.0), (100.0, 10.0))
    ]
    rows += [
        row("yaw", yaw, share, "deg", target, None) for share, target in ((50.0, None), (95.0, 5.0), (100.0, None))
    ]
    rows.append(row("size", size, 95.0, "mm", None, None))
    return [*rows, Row(f"{name}_refused", float(sum(refused.values())), "", "lower", None, n=done)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="40 poses")
    parser.add_argument("--poses", type=int, default=200, help="for each camera and kind of depth")
    parser.add_argument("--first-seed", type=int, default=5000)
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    studio = Studio()
    rows: list[Row] = []
    for camera in ("overhead", "wrist"):
        for noisy in (False, True):
            rows += measure(studio, camera, noisy, 40 if args.quick else args.poses, args.first_seed)
    studio.close()
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
