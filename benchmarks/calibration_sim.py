# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration on rendered images of the simulated robot, for true mounts of many seeds.

    python -m benchmarks.calibration_sim [--quick] [--seeds N] [--json PATH]

The robot is set to random postures in which the nominal mounts promise a view of the board and nothing touches; images
are rendered from the true mounts, detected and solved. No nodes, no dynamics: what is measured is detection and solver.
The postures are random, not chosen for what they tell.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("LP_NUM_THREADS", "1")

import numpy as np

from benchmarks.report import Row, write_report
from openarm_calibration.handeye.offline import calibrate
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.transforms import difference
from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras, true_mount
from openarm_evaluation.campaign.mounts import Bench

CAMERAS = ("wrist", "overhead")
COUNTS = (15, 10)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="4 seeds")
    parser.add_argument("--seeds", type=int, help="how many; 20, with --quick 4")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    errors: dict[tuple[str, int], list[tuple[float, float, float]]] = {}
    for seed in range(1, 1 + (arguments.seeds or (4 if arguments.quick else 20))):
        for camera in CAMERAS:
            for count, error in measure(camera, seed).items():
                errors.setdefault((camera, count), []).append(error)
    rows: list[Row] = []
    for (camera, count), values in errors.items():
        t, r, squares = np.array(values).T
        for kind, figure, unit, target in (("mm", t * 1e3, "mm", 0.3), ("deg", np.degrees(r), "deg", 0.03)):
            stem = f"rendered_{camera}_{count}_{kind}"
            rows.append(Row(f"{stem}_p50", float(np.median(figure)), unit, "lower", target, n=len(values)))
            rows.append(Row(f"{stem}_max", float(np.max(figure)), unit, "lower", target, n=len(values)))
        stem = f"rendered_{camera}_{count}_nees"
        rows.append(Row(f"{stem}_mean", float(np.mean(squares)), "", "in 5..7", 6.0, n=len(values)))
    write_report(rows, arguments.json)


def measure(name: str, seed: int) -> dict[int, tuple[float, float, float]]:
    """Error of a camera at true mounts of a seed by number of samples: m, rad, and its normalised square."""
    began = time.perf_counter()
    camera = load_cameras()[name]
    true = true_mount(camera, seed)
    found: dict[int, tuple[float, float, float]] = {}
    text: list[str] = []
    px = math.nan
    bench = Bench(camera, seed)
    bench.fill(np.random.default_rng(seed), COUNTS[0])
    for count in COUNTS:
        while len(bench.samples) > count:
            bench.samples.remove("")
        result = calibrate(bench.samples)
        offset, angle = mount_error(result.calibration.T_parent_link, true)
        away = difference(result.solution.estimate.X[0], true @ T_LINK_OPTICAL)
        square = float(away @ np.linalg.solve(result.solution.mount_covariance(), away))
        found[count] = (offset, angle, square)
        px = result.solution.estimate.noise.px
        text.append(f"{count}: {offset * 1e3:.4f} mm {math.degrees(angle):.4f} deg {result.verdict.grade}")
    before = mount_error(camera.T_parent_link, true)[0]
    print(
        f"seed {seed:2d} {name:9s} nominal {before * 1e3:5.2f} mm  {'  '.join(text)}"
        f"  marks {px:.3f} px  {time.perf_counter() - began:.1f} s",
        flush=True,
    )
    return found


if __name__ == "__main__":
    main()
