# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration through the nodes, for robots and true mounts of many seeds, judged by what is true.

    python -m benchmarks.calibration_nodes [--quick] [--seeds 1-30] [--poses 15] [--profile openarm|ideal]
                                           [--out FOLDER] [--json PATH]

For each seed a graph `calibrate` is started, as `openarm calibrate auto` does: the arm moves, takes samples of the
board in each hand and on the table, and zeros of the joints and mounts are determined together. With `--profile
openarm`, the default of every graph, zeros of the joints are off by 0.1° rms and motors give way to gravity; robot and
mounts are those of the seed. With `--out`, results lie in a folder by seed, and seeds that are there are not run again.

NEES is the squared error of a mount over its covariance: 6 on average, where that is right. *Hand* is how far the tool
centre point is from where the camera sees the place that it goes to. Only this judge knows mounts and zeros.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np

from benchmarks.report import Row, write_report
from openarm_bringup.calibration.run import CalibrationOptions, CalibrationRun, run_calibration
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.transforms import difference
from openarm_calibration.handeye.zero_sets import ZerosCalibration
from openarm_calibration.sampling.samples import SampleSet, load_session
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, load_cameras, true_mount, uncertain_cameras
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array
from openarm_evaluation.campaign.options import parse_seeds
from openarm_sim_bridge.world.hardware import IDEAL, HardwareConfig, drawn


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="one seed")
    parser.add_argument("--seeds", default="1-30", help="of mounts and robots, such as 1-30")
    parser.add_argument("--poses", type=int, default=15, help="samples a board at most")
    parser.add_argument("--profile", choices=("openarm", "ideal"), default="openarm", help="motors of the arms")
    parser.add_argument("--out", type=Path, help="folder of results by seed; what is there is not run again")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for seed in (1,) if arguments.quick else parse_seeds(arguments.seeds):
        file = arguments.out / f"{arguments.profile}-{seed}-{arguments.poses}.json" if arguments.out else None
        if file is not None and file.is_file():
            rows += json.loads(file.read_text())
            continue
        found = measure(seed, arguments.poses, arguments.profile)
        rows += found
        for row in found:
            print(line(row), flush=True)
        if file is not None and all("error" not in row for row in found):
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(found, indent=1))
    write_report(summary(rows, arguments.profile), arguments.json)


def measure(seed: int, poses: int, profile: str) -> list[dict[str, Any]]:
    """Calibrate the robot of a seed; a row a camera."""
    began = time.perf_counter()
    hardware = IDEAL if profile == "ideal" else HardwareConfig().of_seed(seed)
    sets = [f"mujoco_bridge.profile={profile}"]
    if profile == "openarm":
        sets += [f"mujoco_bridge.openarm.{name}={seed}" for name in ("zero_seed", "dynamics_seed")]
    run = run_calibration(CalibrationOptions(mount_seed=seed, poses=poses, zeros=True, sets=tuple(sets)))
    if run.error is not None and run.error.code == Code.CANCELLED:
        raise SystemExit(1)
    if run.found is None:
        said = run.error or next(result for result in run.results.values() if not result.success)
        return [{"seed": seed, "camera": "", "error": f"{said.code}: {said.message}"}]
    added = drawn(hardware, RobotDescription.load()).zero
    return [
        {"seed": seed, "wall_s": time.perf_counter() - began, "robot_s": run.robot_s, **judged(run, name, seed, added)}
        for name in uncertain_cameras()
    ]


def judged(run: CalibrationRun, name: str, seed: int, added: Mapping[str, float]) -> dict[str, Any]:
    """Return the errors of a camera's mount, and those that were predicted.

    Args:
        run: That ended well.
        name: Name of the camera.
        seed: Seed of the true mounts.
        added: To true positions of joints, in what they report, rad.
    """
    found, camera = run.found, load_cameras()[name]
    assert found is not None
    true, row = true_mount(camera, seed), run.rows()[name]
    offset, angle = mount_error(np.array(row["T_parent_link"]), true)
    solution = found.result.solution
    k = next(number for number, mount in enumerate(found.mounts) if mount.camera == name)
    away = difference(solution.estimate.X[k], true @ T_LINK_OPTICAL)
    described = RobotDescription.load()
    hands = [
        hand(found, samples, true @ T_LINK_OPTICAL, added)
        for samples in (load_session(path, described)[0] for path in run.sessions)
        if samples.head.camera == name
    ]
    zeros = [(n, o + added[n]) for n, o in found.zeros.offsets.items()]
    determined = [off for n, off in zeros if n not in found.zeros.by_prior]
    return {
        "camera": name, "mm": offset * 1e3, "deg": math.degrees(angle), "grade": row["grade"],
        "sigma_mm": row["sigma_translation"] * 1e3, "sigma_deg": math.degrees(row["sigma_rotation"]),
        "nees": float(away @ np.linalg.solve(solution.mount_covariance(k), away)),
        "hand_mm": max(hands) * 1e3, "sigma_hand_mm": row["hand"] * 1e3, "message": row["message"],
        "zeros_deg": math.degrees(float(np.sqrt(np.mean(np.square(determined))))) if determined else math.nan,
        "determined": len(determined),
    }  # fmt: skip


def hand(found: ZerosCalibration, samples: SampleSet, true: Array, added: Mapping[str, float]) -> float:
    """Return how far the tool centre point is from where the camera sees the place that it goes to, rms, m.

    Args:
        found: Zeros and mounts in use.
        samples: Samples of one camera and arm; its postures.
        true: (4, 4) mount of the optical frame.
        added: To true positions of joints, in what they report, rad.
    """
    head, real = samples.head, samples.description.described
    believed = real.with_zeros(found.zeros.offsets)
    used = next(mount for mount in found.mounts if mount.camera == head.camera).T_parent_link @ T_LINK_OPTICAL
    tcp = real.tcp_link(real.arm_of(head.carrier))
    home, square = dict.fromkeys(real.joints, 0.0), list[float]()
    postures = [home | dict(sample.joints) for sample in samples.samples]
    for look, go in zip([postures[-1], *postures[:-1]], postures, strict=True):
        truly = [{name: at - added.get(name, 0.0) for name, at in q.items()} for q in (look, go)]
        seen = se3.inverse(believed.link_pose(head.parent, look) @ used) @ believed.link_pose(tcp, go)[:, 3]
        there = real.link_pose(head.parent, truly[0]) @ true @ seen
        square.append(float(np.sum((there - real.link_pose(tcp, truly[1])[:, 3])[:3] ** 2)))
    return math.sqrt(np.mean(square))


def line(row: dict[str, Any]) -> str:
    """Return what is printed of one calibration."""
    if "error" in row:
        return f"seed {row['seed']:2d} {row['camera']:9s} {row['error']}"
    mount = f"{row['mm']:.3f} mm {row['deg']:.4f}° (± {row['sigma_mm']:.3f} mm {row['sigma_deg']:.4f}°)"
    hand = f"hand {row['hand_mm']:.3f} mm (± {row['sigma_hand_mm']:.3f})"
    zeros = f"{row['determined']} zeros to {row['zeros_deg']:.4f}°, {row['grade']}"
    took = f"robot {row['robot_s']:.0f} s of {row['wall_s']:.0f} s"
    return f"seed {row['seed']:2d} {row['camera']:9s} {mount}, NEES {row['nees']:.1f}, {hand}, {zeros}, {took}"


def summary(rows: list[dict[str, Any]], profile: str) -> list[Row]:
    """Return the figures of each camera; a calibration without an answer counts as infinitely wrong."""
    out: list[Row] = []
    failed = sum("error" in row for row in rows)
    limits = {"mm": (0.6, 1.5), "deg": (None, 0.12), "hand_mm": (None, None)}
    for name in uncertain_cameras():
        mine = [row for row in rows if row["camera"] == name]
        stem, n = f"{profile}_{name}", len(mine) + failed
        for kind, targets in limits.items():
            values = np.array([row[kind] for row in mine] + [math.inf] * failed)
            for part, target in zip((50, 95), targets, strict=True):
                value = float(np.percentile(values, part)) if np.isfinite(values).all() else math.inf
                out.append(Row(f"{stem}_{kind}_p{part}", value, kind.removeprefix("hand_"), "lower", target, n=n))
        nees = float(np.mean([row["nees"] for row in mine])) if mine else math.nan
        out.append(Row(f"{stem}_nees_mean", nees, "", "in 4..9", 6.0, n=n))
        passed = sum(row["grade"] == "pass" for row in mine)
        right = sum((row["mm"] <= 1.0 and row["deg"] <= 0.1) for row in mine if row["grade"] == "pass")
        out.append(Row(f"{stem}_passed", passed, "", "higher", None, n=n))
        out.append(Row(f"{stem}_passed_within_limits", right, "", "higher", None, n=passed))
    good = [row for row in rows if "error" not in row]
    for kind, unit in (("zeros_deg", "deg"), ("robot_s", "s"), ("wall_s", "s")):
        values = [row[kind] for row in good if math.isfinite(row[kind])]
        out.append(
            Row(
                f"{profile}_{kind}_p50",
                float(np.median(values)) if values else math.nan,
                unit,
                "lower",
                None,
                n=len(values),
            )
        )
    return out


if __name__ == "__main__":
    main()
