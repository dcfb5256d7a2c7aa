# SPDX-License-Identifier: Apache-2.0
"""What a calibration is worth to a grasp: the same scenes, the same true mounts, with and without it.

    python -m benchmarks.calibration_matters [--quick] [--seeds 1-20] [--json PATH]

Physics, cameras, detection, planner and grasp are those of the node graph, in one process; judged by ground truth.
First the scene `narrow` at mount seed 1, then every object of the scene `demo` at true mounts of many seeds, each
calibrated from its own images. `--quick` takes mount seed 1 alone, with the calibration that comes with the suite.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from numpy.typing import NDArray

from benchmarks.report import Row, write_report
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.store.store import CalibrationStore
from openarm_common.camera.cameras import load_cameras, true_mount
from openarm_common.resources import models_dir
from openarm_common.scene.scene import load_scene
from openarm_evaluation.campaign.mounts import with_mounts
from openarm_evaluation.campaign.options import parse_seeds
from openarm_evaluation.campaign.robot import Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig

#: The cameras that grasps look through; the first tells where objects are.
CAMERAS = ("overhead", "wrist")
Mounts = Mapping[str, NDArray[np.float64]]


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="mount seed 1 alone")
    parser.add_argument("--seeds", default="1-20", help="of the mounts")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    shipped = shipped_mounts()
    narrow = [compare("narrow", "red", 1, shipped)]
    demo: list[tuple[dict[str, Any], dict[str, Any]]] = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in (1,) if arguments.quick else parse_seeds(arguments.seeds):
            mounts = shipped if seed == 1 else calibrated_mounts(seed, Path(folder))
            for item in load_scene("demo").objects:
                demo.append(compare("demo", item.label, seed, mounts))
    rows = [*summary("narrow", narrow), *summary("demo", demo)]
    write_report(rows, arguments.json)


def shipped_mounts() -> Mounts:
    """Of mount seed 1, as calibrated by the suite."""
    store = CalibrationStore(models_dir() / "robots" / "openarm_v1" / "calibration" / "mount_seed_1")
    return {name: store.load(name).T_parent_link for name in CAMERAS}


def calibrated_mounts(seed: int, folder: Path) -> Mounts:
    """Of any mount seed, calibrated now."""
    blank = Task("matters", seed, load_scene("empty"), ())
    return with_mounts(blank, [seed], folder)[1]


def compare(scene: str, label: str, seed: int, mounts: Mounts) -> tuple[dict[str, Any], dict[str, Any]]:
    """Grasp an object twice, without and with the calibrated mounts; prints both."""
    task = Task("matters", 0, load_scene(scene), (label,), mount_seed=seed)
    # the detector would notice most of these mounts by the table, and refuse
    senses = SimulatedSenses(depth_noise=False, sets=("detector.watch.enabled=false",))
    nominal, calibrated = (Trials(task, senses, GraspConfig(), Known(used)).run() for used in ({}, mounts))
    camera = load_cameras()[CAMERAS[0]]
    true = true_mount(camera, seed)
    away = [mount_error(T, true)[0] * 1e3 for T in (camera.T_parent_link, mounts[CAMERAS[0]])]
    print(
        f"mount seed {seed:2d} {scene:7s}{label:7s} without ({away[0]:5.2f} mm off): {outcome(nominal):58s}"
        f" with ({away[1]:.3f} mm off): {outcome(calibrated)}",
        flush=True,
    )
    return nominal, calibrated


def outcome(row: Mapping[str, Any]) -> str:
    """How a grasp went."""
    if row["place_error_mm"] is not None and row["code"] == "OK":
        return f"placed {row['place_error_mm']:.1f} mm off at attempt {row['attempts']}"
    claim = "claimed success, but " if row["false_success"] else f"{row['code']}, "
    return claim + (row["reasons"] or ["as it said"])[0]


def summary(scene: str, pairs: list[tuple[dict[str, Any], dict[str, Any]]]) -> list[Row]:
    """Shares and errors with calibration and without."""
    n = len(pairs)

    def share(side: int, first: bool) -> float:
        return sum(pair[side]["placed"] and (not first or pair[side]["attempts"] == 1) for pair in pairs) / n

    def error(side: int) -> float:
        found = [pair[side]["place_error_mm"] for pair in pairs if pair[side]["placed"]]
        return float(np.median(found)) if found else float("nan")

    peer = "uncalibrated"
    return [
        Row(f"matters_{scene}_placed", share(1, False), "", "higher", 1.0, peer, share(0, False), n),
        Row(f"matters_{scene}_first_attempt", share(1, True), "", "higher", 0.95, peer, share(0, True), n),
        Row(f"matters_{scene}_place_error_p50", error(1), "mm", "lower", 5.0, peer, error(0), n),
    ]


if __name__ == "__main__":
    main()
