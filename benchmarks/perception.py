# SPDX-License-Identifier: Apache-2.0
"""Depth to cloud and to octree, compared with the usual ways of doing it on the same images in the same run.

    python benchmarks/perception.py [--quick] [--bindings PYTHON] [--json PATH]

Images are those of both cameras of the simulated robot (640 x 480, 16UC1, as noisy as a D435's: errors that grow with
the square of the depth, flying pixels, holes) over demo and random scenes. Times are CPU times of one thread, median; a
cycle is one update from the images of both cameras.

    cloud_ms               depth image to organised points; peer: numpy with a meshgrid for every image
    octree_cycle_ms        end cells, rays, log-odds and the binary octree of two cameras; peer: liboctomap (C++)
    octree_cycle_full_ms   the same with self-filter, distance field and the reset of the robot's cells
    pyoctomap_ratio, octomap_python_ratio   time of a Python binding of liboctomap for a cycle over ours
    ..._round_trip         1 when our .bt file has the same bytes after that binding has read and written it
    distance_field_ms      of that: the distance field
    self_filter_ms         of that: the labels of both images
    flying_ms              of that: the pixels between surfaces in both images
    voxel_mismatch         cells that differ from liboctomap's after all frames, cleared ones among them
    octree_memory_mb       of the map with all that an update needs; peer: the tree of liboctomap alone
    hall_...               the same of scans of a hall, see benchmarks/map_hall.py
    map_iou, map_ghosts, map_missed   the map against the geometry of the simulator, true mounts, noisy depth
    clear_ms, mark_ms      simulated time from an object's removal (arrival) to the map without (with) it, worst phase

liboctomap is compiled from benchmarks/liboctomap_peer.cpp when g++ and its headers are there: those of Debian's
liboctomap-dev, or those that come with the wheel cmeel-octomap (a dependency of pin). pyoctomap and octomap-python are
used when this Python has them, or another one given by --bindings.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from benchmarks.liboctomap import THEIRS, insert
from benchmarks.map_accuracy import compare
from benchmarks.map_hall import hall_rows
from benchmarks.map_scene import MapScene
from benchmarks.report import Row, write_report
from openarm_common.camera.flying_pixels import FlyingConfig, label_flying
from openarm_common.octree.blocks import VoxelBlocks
from openarm_common.octree.codec import read_file, write_file
from openarm_common.robot.self_filter import SelfFilter
from openarm_common.scene.scene import load_scene, random_scene
from openarm_octomap.config import FieldConfig, FilterConfig, GridConfig
from openarm_octomap.distance import DistanceTransform
from openarm_octomap.grid import DepthScan, OccupancyGrid
from openarm_octomap.kernels import FREE, OCCUPIED, UNKNOWN
from openarm_octomap.mapper import Frame, Mapper
from openarm_perception.geometry.depth import Deprojector, DepthLimits

PERIOD_NS = 500_000_000


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Median CPU time of a call, ms; one call before does not count."""
    work()
    times: list[float] = []
    for _ in range(repeats):
        begin = time.process_time()
        work()
        times.append(time.process_time() - begin)
    return float(np.median(times)) * 1e3


def meshgrid_cloud(scan: DepthScan) -> np.ndarray:
    """As tutorials do it."""
    k = scan.intrinsics
    z = scan.depth / 1000.0
    u, v = np.meshgrid(np.arange(k.width), np.arange(k.height))
    points = np.stack([(u - k.cx) * z / k.fx, (v - k.cy) * z / k.fy, z], axis=-1)
    points[z == 0] = np.nan
    return points


def record(quick: bool) -> list[list[Frame]]:
    """Pairs of images over changing scenes, arms in changing postures."""
    rng = np.random.default_rng(5)
    out: list[list[Frame]] = []
    for seed in range(2 if quick else 5):
        scene = MapScene(random_scene(seed) if seed else load_scene("demo"))
        for i in range(3 if quick else 4):
            for side in ("left", "right"):
                for joint in (1, 2, 4, 6):
                    scene.joints[f"openarm_{side}_joint{joint}"] += float(rng.uniform(-0.15, 0.15))
            out.append(scene.frames((4 * seed + i) * PERIOD_NS, rng))
        scene.close()
    return out


def cloud_rows(frames: Sequence[Frame], repeats: int) -> list[Row]:
    """The organised cloud of one image."""
    scan = frames[0].scan
    if not isinstance(scan, DepthScan):
        raise TypeError("a camera gives depth images")
    deprojector = Deprojector(DepthLimits(near=scan.near, far=scan.far))
    out = np.empty((*scan.depth.shape, 3), np.float32)
    ours = cpu_ms(lambda: deprojector.organised(scan.depth, scan.intrinsics, out), repeats)
    peer = cpu_ms(lambda: meshgrid_cloud(scan), max(5, repeats // 5))
    return [Row("cloud_ms", ours, "ms", "lower", 1.0, "numpy meshgrid", peer, repeats)]


def octree_rows(pairs: Sequence[Sequence[Frame]], repeats: int, python: str) -> list[Row]:
    """The octree, exact, compared with liboctomap and its bindings on the same points."""
    grid = OccupancyGrid(GridConfig(**THEIRS))
    times: list[float] = []
    for turn in range(max(1, repeats // len(pairs)) + 1):
        grid.reset()
        for pair in pairs:
            begin = time.process_time()
            for frame in pair:
                grid.integrate([frame.scan], frame.t_ns)
            grid.binary()
            times += [time.process_time() - begin] if turn else []
    ours = float(np.median(times)) * 1e3
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as folder:
        clouds = [frame.scan for pair in pairs for frame in pair]
        peer = insert([(scan.points(), scan.T_base_camera[:3, 3]) for scan in clouds], Path(folder), 0.02, every=2)
        if peer is not None:
            cycle, states = peer.ms / len(pairs), read_file(peer.map).on(grid.lattice)[0]
            theirs = np.where(np.isnan(states), UNKNOWN, np.where(states > 0, OCCUPIED, FREE))
            different = int(np.count_nonzero(theirs != grid.blocks.states()))
            rows.append(Row("octree_cycle_ms", ours, "ms", "lower", 25.0, "liboctomap C++", cycle, len(times)))
            rows.append(Row("voxel_mismatch", different, "", "lower", 0.0, n=int(np.count_nonzero(theirs))))
            memory = grid.nbytes / 1e6
            rows.append(Row("octree_memory_mb", memory, "MB", "lower", None, "liboctomap C++", peer.memory_mb))
        else:
            rows.append(Row("octree_cycle_ms", ours, "ms", "lower", 25.0, n=len(times)))
        write_file(Path(folder) / "ours.bt", grid.binary(), grid.lattice.resolution)
        for name, answer in bindings(clouds, Path(folder), python).items():
            key, theirs = name.replace("-", "_"), answer["ms"]
            rows.append(Row(f"{key}_ratio", theirs / ours, "x", "higher", None, f"{name} ms", theirs, len(pairs)))
            rows.append(Row(f"{key}_round_trip", int(answer["same"]), "", "higher", 1.0))
    return rows


def bindings(scans: Sequence[DepthScan], folder: Path, python: str) -> dict[str, dict[str, float]]:
    """What the Python bindings of liboctomap take for a pair of frames, and what they make of our map in `ours.bt`."""
    some = scans[:4]
    arrays = {f"p{i}": scan.points() for i, scan in enumerate(some)}
    arrays |= {f"o{i}": scan.T_base_camera[:3, 3].astype(np.float32) for i, scan in enumerate(some)}
    np.savez(folder / "frames.npz", n=len(some), **arrays)
    script = Path(__file__).with_name("octomap_bindings.py")
    arguments = [python, str(script), str(folder / "frames.npz"), str(folder / "ours.bt"), str(folder)]
    answers = json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)
    for name in sorted({"pyoctomap", "octomap-python"} - answers.keys()):
        print(f"{name}: {python} does not have it (--bindings PYTHON names one that has); left out")
    return answers


def full_rows(scene: MapScene, pairs: Sequence[Sequence[Frame]], repeats: int) -> list[Row]:
    """What the node does in an update, and its parts."""
    mapper = Mapper(scene.body, GridConfig(), FilterConfig(), FieldConfig())
    distances = np.empty(mapper.lattice.shape, np.float32)
    times: list[float] = []
    for turn in range(max(1, repeats // len(pairs)) + 1):
        for pair in pairs:
            begin = time.process_time()
            report = mapper.update(pair, distances=distances, wanted={"states"})
            times += [time.process_time() - begin] if turn else []
    if report.snapshot.states is None:
        raise TypeError("the states were asked for")
    blocks = VoxelBlocks(mapper.lattice)
    blocks.set_layers(0, np.array([np.nan, -1.0, 1.0], np.float32)[report.snapshot.states])
    transform = DistanceTransform(mapper.lattice, FieldConfig().reach)
    robot = SelfFilter(scene.body, FilterConfig())

    def label() -> None:
        for frame in pairs[0]:
            robot.label_depth(frame.scan, robot.shapes(frame.joints or {}))

    def drop_flying() -> None:
        for frame in pairs[0]:
            if isinstance(frame.scan, DepthScan):
                label_flying(frame.scan, FlyingConfig(), np.zeros(frame.scan.depth.shape, np.uint8))

    n = len(times)
    return [
        Row("octree_cycle_full_ms", float(np.median(times)) * 1e3, "ms", "lower", 40.0, n=n),
        Row(
            "distance_field_ms", cpu_ms(lambda: transform.compute(blocks, distances), repeats), "ms", "lower", 13.0, n=n
        ),
        Row("self_filter_ms", cpu_ms(label, repeats), "ms", "lower", None, n=n),
        Row("flying_ms", cpu_ms(drop_flying, repeats), "ms", "lower", 1.0, n=n),
    ]


def accuracy_rows(quick: bool) -> list[Row]:
    """The map against the geometry, and how long changes take to show; noisy depth, true mounts."""
    ious, ghosts, missed, clear, mark = [], 0, 0, [], []
    seeds = range(2 if quick else 10)
    for seed in seeds:
        rng = np.random.default_rng(seed)
        world = random_scene(seed)
        scene = MapScene(world)
        looking = scene.description.group_state("right_arm", "wrist_look")  # at the table, as the other camera does
        scene.joints |= {name: q for name, q in looking.items() if name in scene.joints}
        mapper = Mapper(scene.body, GridConfig(), FilterConfig(), FieldConfig())
        homes = {item.name: item.centre(world.table) for item in world.objects}

        def put(there: bool, scene: MapScene = scene, homes: dict[str, tuple[float, float, float]] = homes) -> None:
            for i, (name, home) in enumerate(homes.items()):
                scene.put(name, home if there else (3.0 + i, 3.0, 0.5))

        t_ns = 0
        for there, times in ((True, None), (False, clear), (True, mark)):
            put(there)
            truth = scene.truth(mapper.lattice)
            # the change happens right after an update: the worst moment
            for cycle in range(1, 9):
                t_ns += PERIOD_NS
                states = mapper.update(scene.frames(t_ns, rng), wanted={"states"}).snapshot.states
                if states is None:
                    raise TypeError("the states were asked for")
                result = compare(states, truth.surface, truth.solid)
                if times is not None and result.ghosts == 0 and result.missed <= 0.01 * result.surface:
                    times.append(cycle * PERIOD_NS * 1e-6)
                    break
        ious.append(result.iou)
        ghosts, missed = ghosts + result.ghosts, missed + result.missed
        scene.close()
    n = len(seeds)
    return [
        Row("map_iou", min(ious), "", "higher", 0.95, n=n),
        Row("map_ghosts", ghosts, "", "lower", 0.0, n=n),
        Row("map_missed", missed, "", "lower", None, n=n),
        Row("clear_ms", max(clear) if len(clear) == n else float("inf"), "ms", "lower", 1000.0, n=n),
        Row("mark_ms", max(mark) if len(mark) == n else float("inf"), "ms", "lower", 1000.0, n=n),
    ]


def main() -> None:
    """Run all parts."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer scenes and repetitions")
    parser.add_argument("--bindings", default=sys.executable, metavar="PYTHON", help="a Python with the bindings")
    parser.add_argument("--json", type=Path, default=None, help="also write the report there")
    args = parser.parse_args()
    repeats = 20 if args.quick else 100
    pairs = record(args.quick)
    scene = MapScene(load_scene("demo"))
    rows = cloud_rows(pairs[0], repeats) + octree_rows(pairs, repeats, args.bindings)
    rows += full_rows(scene, pairs, repeats) + hall_rows(1 if args.quick else 3)
    scene.close()
    rows += accuracy_rows(args.quick)
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
