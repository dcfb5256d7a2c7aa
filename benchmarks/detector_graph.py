# SPDX-License-Identifier: Apache-2.0
"""The network detector on frames of the running graph: what the overhead camera publishes, boxes from ground truth.

    python benchmarks/detector_graph.py [--frames N] [--first-seed S] [--out FOLDER] [--json PATH]

Starts the graph `perception`, loads a scene per frame (random scenes in which every third object is a ball instead),
takes the first image that shows it, and projects the objects through the nominal mount. Nothing here was trained on:
textures, light and noise are those of the graph. The frames are left as a data set (set `report`) in FOLDER.

    map50, centre_error_px, precision, recall    of the default network, at a score of one half the last two
"""

from __future__ import annotations

import argparse
import asyncio
import os
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import yaml
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_bringup.supervision import environment
from openarm_bringup.supervision.graph import load_graph
from openarm_bringup.supervision.session import running_graph
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras
from openarm_common.domain import reserve_domain
from openarm_common.scene.scene import SHAPES, Scene, random_scene
from openarm_evaluation.detector.appearance import surface
from openarm_evaluation.detector.training.report import evaluate
from openarm_evaluation.detector.training.samples import Samples
from openarm_evaluation.detector.yolo_text import write_classes, write_labels
from openarm_evaluation.judging.ros.observer import Observer
from openarm_perception.detection.network import NetworkConfig, NetworkDetector

CAMERA, TOPIC = load_cameras()["overhead"], "/overhead/color/image_raw"


def scene_of(seed: int) -> Scene:
    """A random scene in which every third object, counted over all scenes, is a ball."""
    scene = random_scene(seed, count=3)
    items = list(scene.objects)
    edge = min(items[seed % 3].size)
    items[seed % 3] = items[seed % 3].model_copy(update={"shape": "sphere", "size": (edge, edge, edge)})
    return scene.model_copy(update={"objects": tuple(items)})


def boxes_of(scene: Scene, poses: dict[str, NDArray[np.float64]]) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Classes and boxes of a scene's objects in the image, T_world_object by name."""
    T_optical_world = se3.inverse(CAMERA.T_parent_optical)
    kinds, boxes = [], []
    for item in scene.objects:
        points = se3.apply(T_optical_world @ poses[item.name], surface(item.shape, np.array(item.size) / 2.0))
        pixels = CAMERA.intrinsics.project(points) + 0.5  # a pixel covers one unit around its middle
        kinds.append(SHAPES.index(item.shape))
        boxes.append([*pixels.min(axis=0), *pixels.max(axis=0)])
    return np.array(kinds, np.int64), np.array(boxes).clip(0.0, [CAMERA.width, CAMERA.height] * 2)


def take(observer: Observer, seeds: range, folder: Path, scenes: Path) -> None:
    """Write a frame and its labels for every seed."""
    observer.watch_camera(TOPIC)
    for seed in seeds:
        scene = scene_of(seed)
        path = scenes / f"scene_{seed}.yaml"
        path.write_text(yaml.safe_dump(scene.model_dump(mode="json")), encoding="utf-8")
        after_ns = observer.reset_world(str(path), 0) + 200_000_000

        def shown(after_ns: int = after_ns, scene: Scene = scene):
            frame, truth = observer.frame(TOPIC), observer.truth()
            names = {item.name for item in scene.objects}
            there = truth is not None and truth.t_ns > after_ns and set(truth.objects) == names
            return (frame, truth) if there and frame is not None and frame[0] > after_ns else None

        (_, rgb), truth = observer.wait(shown, 30.0, "a frame of the new scene")
        poses = {n: se3.make(se3.matrix_from_quat_xyzw(s.q_xyzw), s.p_world) for n, s in truth.objects.items()}
        kinds, boxes = boxes_of(scene, poses)
        cv2.imwrite(str(folder / "images" / "report" / f"{seed:06}.png"), cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR))
        text = write_labels(kinds, boxes, CAMERA.width, CAMERA.height)
        (folder / "labels" / "report" / f"{seed:06}.txt").write_text(text, encoding="utf-8")


async def capture(seeds: range, folder: Path) -> None:
    """Run the graph and take the frames."""
    with tempfile.TemporaryDirectory() as run:
        graph = load_graph(
            "perception", overrides={"domain": reserve_domain()}, sets=("mujoco_bridge.mount_seed=none",)
        )
        os.environ.update(environment.ros_environment(graph))
        for name in ("logs", "params"):
            (Path(run) / name).mkdir()
        async with running_graph(graph, Path(run)) as supervisor:
            await supervisor.wait_ready()
            with Observer(environment.domain_id(graph)) as observer, ThreadPoolExecutor(1) as pool:
                work = take, observer, seeds, folder, Path(run)
                await asyncio.get_running_loop().run_in_executor(pool, *work)


def main() -> None:
    """Take frames, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--first-seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/detector/graph"), help="data set of the frames")
    parser.add_argument("--model", default="shapes_640x480", help="ONNX file, or a name in models/detector")
    parser.add_argument("--json", type=Path, help="where the rows go")
    args = parser.parse_args()
    write_classes(args.out, SHAPES, ("report",))
    for kind in ("images", "labels"):
        (args.out / kind / "report").mkdir(parents=True, exist_ok=True)
    seeds = range(args.first_seed, args.first_seed + args.frames)
    left = [s for s in seeds if not (args.out / "labels" / "report" / f"{s:06}.txt").is_file()]
    if left:
        asyncio.run(capture(range(left[0], seeds.stop), args.out.resolve()))
    samples = Samples(args.out, "report")
    result = evaluate(NetworkDetector(NetworkConfig(model=args.model)), samples).scores
    n = len(samples)
    rows = [
        Row("map50", result.map50, "", "higher", 0.9, n=n),
        *(Row(f"ap50_{k}", v, "", "higher", None, n=n) for k, v in zip(samples.names, result.ap50, strict=True)),
        Row("centre_error_px", result.centre_median_px, "px", "lower", 1.5, n=n),
        Row("precision", result.precision, "", "higher", None, n=n),
        Row("recall", result.recall, "", "higher", None, n=n),
    ]
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
