# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration through the nodes, for true mounts of many seeds, judged by where the mounts really are.

    python -m benchmarks.calibration_nodes [--quick] [--seeds 0-19] [--poses 15] [--cameras overhead,wrist]
                                           [--profile ideal|openarm] [--out FOLDER] [--json PATH]

For each seed a graph `calibrate` is started, and the action /calibration/auto moves the arm, takes the samples and
solves, for one camera after the other. The same samples are solved again with the first ten. With `--out`, results
lie in a folder by seed, and seeds that are there are not run again. Only this judge knows the true mounts.

The robot is exact. With `--profile openarm` its joint zeros are off and its motors give way to gravity, as those of
owners do: the mount that fits such an arm best is not the true one.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np

from benchmarks.report import Row, write_report
from openarm_bringup.calibration.run import CalibrationOptions, as_row, run_calibration
from openarm_calibration.handeye.offline import calibrate
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.sampling.samples import load_session
from openarm_common.camera.cameras import load_cameras, true_mount
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_evaluation.campaign.options import parse_seeds

#: Predicted errors that are never reached, so that the whole budget of poses is used: m, rad.
WHOLE_BUDGET = (1e-9, 1e-9)
FEW = 10


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--seeds", default="0-19", help="of the mounts, such as 0-19")
    parser.add_argument("--poses", type=int, default=15, help="samples a camera")
    parser.add_argument("--cameras", default="overhead,wrist", help="names, joined by commas")
    parser.add_argument("--profile", choices=("ideal", "openarm"), default="ideal", help="motors of the arms")
    parser.add_argument("--out", type=Path, help="folder of results by seed; what is there is not run again")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    cameras = tuple(arguments.cameras.split(","))
    seeds = (1,) if arguments.quick else parse_seeds(arguments.seeds)
    rows: list[dict[str, Any]] = []
    for seed in seeds:
        file = arguments.out / f"{seed}-{arguments.poses}.json" if arguments.out else None
        if file is not None and file.is_file():
            rows += json.loads(file.read_text())
            continue
        found = measure(seed, cameras, arguments.poses, arguments.profile)
        rows += found
        for row in found:
            print(line(row), flush=True)
        if file is not None and all("error" not in row for row in found):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(found, indent=1))
    write_report(summary(rows, cameras, arguments.poses), arguments.json)


def measure(seed: int, cameras: tuple[str, ...], poses: int, profile: str) -> list[dict[str, Any]]:
    """Calibrate with the true mounts of one seed; a row a camera."""
    began = time.perf_counter()
    sets = (f"mujoco_bridge.profile={profile}",)
    run = run_calibration(CalibrationOptions(cameras, mount_seed=seed, poses=poses, enough=WHOLE_BUDGET, sets=sets))
    out: list[dict[str, Any]] = []
    if run.error is not None:
        if run.error.code == Code.CANCELLED:
            raise SystemExit(1)
        out.append({"seed": seed, "camera": "", "error": f"{run.error.code}: {run.error.message}"})
    for name, result in run.results.items():
        camera = load_cameras()[name]
        true = true_mount(camera, seed)
        row: dict[str, Any] = {"seed": seed, "camera": name, **as_row(result)}
        if row["T_parent_link"] is None:
            row["error"] = f"{result.code}: {result.message}"
        else:
            offset, angle = mount_error(np.array(row["T_parent_link"]), true)
            row |= {"mm": offset * 1e3, "deg": math.degrees(angle)}
            row["nominal_mm"] = mount_error(camera.T_parent_link, true)[0] * 1e3
            row |= with_few(run.run_dir / f"{name}.npz", true)
        row["wall_s"] = time.perf_counter() - began
        out.append(row)
    return out


def with_few(session: Path, true: Array) -> dict[str, float]:
    """Errors of the calibration by the first samples alone."""
    samples, _ = load_session(session, RobotDescription.load())
    while len(samples) > FEW:
        samples.remove("")
    try:
        result = calibrate(samples)
    except OpenArmError as error:
        print(f"{session}: with {FEW} samples: {error.message}")
        return {"few_mm": math.inf, "few_deg": math.inf}
    offset, angle = mount_error(result.calibration.T_parent_link, true)
    return {"few_mm": offset * 1e3, "few_deg": math.degrees(angle)}


def line(row: dict[str, Any]) -> str:
    """What is printed of one calibration."""
    if "error" in row:
        return f"seed {row['seed']:2d} {row['camera']:9s} {row['error']}"
    return (
        f"seed {row['seed']:2d} {row['camera']:9s} nominal {row['nominal_mm']:5.2f} mm  {row['samples']} poses:"
        f" {row['mm']:.4f} mm {row['deg']:.4f} deg (predicted {row['sigma_translation'] * 1e3:.4f} mm), {FEW} poses:"
        f" {row['few_mm']:.4f} mm {row['few_deg']:.4f} deg, {row['grade']}, {len(row['missed'])} poses missed,"
        f" {row['duration']:.0f} s"
    )


def summary(rows: list[dict[str, Any]], cameras: tuple[str, ...], poses: int) -> list[Row]:
    """Median and largest error of each camera; a calibration without an answer counts as infinitely wrong."""
    out: list[Row] = []
    for camera in cameras:
        mine = [row for row in rows if row["camera"] == camera]
        if not mine:
            continue
        for count, prefix in ((poses, ""), (FEW, "few_")):
            for kind, target in (("mm", 0.3), ("deg", 0.03)):
                values = np.array([row.get(prefix + kind, math.inf) for row in mine])
                stem = f"nodes_{camera}_{count}_{kind}"
                out.append(Row(f"{stem}_p50", float(np.median(values)), kind, "lower", target, n=len(mine)))
                out.append(Row(f"{stem}_max", float(np.max(values)), kind, "lower", target, n=len(mine)))
        times = [row["duration"] for row in mine if "duration" in row]
        out.append(
            Row(f"nodes_{camera}_{poses}_seconds_p50", float(np.median(times)), "s", "lower", 300.0, n=len(times))
        )
    return out


if __name__ == "__main__":
    main()
