# SPDX-License-Identifier: Apache-2.0
"""The map of a hall of 28 × 32 × 12 m at 5 cm, 86 million cells, from a lidar of 128 lines; a part of perception.py.

python -m benchmarks.map_hall [--scans N] [--json PATH]

hall_memory_mb    most that the map, a scan and the octree take together, MB; peer: the tree of liboctomap alone
hall_scan_ms      CPU time of a scan and the binary octree after it; peer: liboctomap (C++)
hall_mismatch     cells that differ from liboctomap's
"""

from __future__ import annotations

import argparse
import tempfile
import time
import tracemalloc
from pathlib import Path

import numpy as np

from benchmarks.liboctomap import THEIRS, insert
from benchmarks.report import Row, write_report
from openarm_common.octree.codec import read_file
from openarm_common.types import Array, Floats
from openarm_octomap.config import GridConfig
from openarm_octomap.grid import CloudScan, OccupancyGrid

HALL = GridConfig(**(THEIRS | {"resolution": 0.05, "lower": (-14.0, -16.0, 0.0), "upper": (14.0, 16.0, 12.0)}))


def clouds(number: int) -> list[tuple[Floats, Array]]:
    """Points (n, 3) of walls, floor, ceiling and two rows of columns, 2 cm of noise, and the eyes (3,), m."""
    rng = np.random.default_rng(3)
    turn, tilt = np.meshgrid(np.linspace(-np.pi, np.pi, 1024, endpoint=False), np.radians(np.linspace(-45, 45, 128)))
    way = np.stack([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)], axis=-1).reshape(-1, 3)
    way[way == 0.0] = 1e-9
    columns = [(x, y) for x in (-6.0, 6.0) for y in np.arange(-12.0, 13.0, 6.0)]
    out: list[tuple[Floats, Array]] = []
    for i in range(number):
        origin = np.array([2.0 * np.sin(i), -13.0 + 26.0 * i / max(number - 1, 1), 1.5])
        wall = np.where(way > 0, (13.9, 15.9, 11.9), (-13.9, -15.9, 0.1))
        reach = ((wall - origin) / way).min(axis=1)
        for column in columns:  # of 0.3 m radius
            to = origin[:2] - column
            a, b, c = (way[:, :2] ** 2).sum(axis=1), way[:, :2] @ to, to @ to - 0.09
            root = b * b - a * c
            near = (-b - np.sqrt(np.maximum(root, 0.0))) / a
            reach = np.where((root > 0.0) & (near > 0.0), np.minimum(reach, near), reach)
        reach += rng.normal(0.0, 0.02, reach.size)
        out.append(((origin + way * reach[:, None]).astype(np.float32), origin))
    return out


def hall_rows(scans: int) -> list[Row]:
    """Memory, time and equality."""
    seen = clouds(scans)
    warm = OccupancyGrid(GridConfig(**THEIRS))
    warm.integrate([CloudScan(seen[0][0][:9], seen[0][1])], 0)
    warm.binary()
    times: list[float] = []
    tracemalloc.start()
    grid = OccupancyGrid(HALL)
    for i, (points, origin) in enumerate(seen):
        begin = time.process_time()
        grid.integrate([CloudScan(points, origin)], i * 100_000_000)
        grid.binary()
        times.append(time.process_time() - begin)
    memory = tracemalloc.get_traced_memory()[1] / 1e6
    tracemalloc.stop()
    ours = float(np.mean(times)) * 1e3
    with tempfile.TemporaryDirectory() as folder:
        peer = insert(seen, Path(folder), HALL.resolution, every=1)
        if peer is None:
            return [
                Row("hall_memory_mb", memory, "MB", "lower", 200.0, n=scans),
                Row("hall_scan_ms", ours, "ms", "lower", None, n=scans),
            ]
        theirs = OccupancyGrid(HALL)
        theirs.load(read_file(peer.map))
    different = known = 0
    for layer in range(int(grid.blocks.shape[0])):
        part = slice(layer, layer + 1)
        states = grid.blocks.states(part)
        known += int(np.count_nonzero(states))
        different += int(np.count_nonzero(states != theirs.blocks.states(part)))
    return [
        Row("hall_memory_mb", memory, "MB", "lower", 200.0, "liboctomap C++", peer.memory_mb, scans),
        Row("hall_scan_ms", ours, "ms", "lower", None, "liboctomap C++", peer.ms / scans, scans),
        Row("hall_mismatch", different, "", "lower", 0.0, n=known),
    ]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scans", type=int, default=3, help="from places along the hall")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    write_report(hall_rows(args.scans), args.json)


if __name__ == "__main__":
    main()
