# SPDX-License-Identifier: Apache-2.0
"""What zeros of the joints that are off by 1° cost, without and with `openarm calibrate zeros`.

    python -m benchmarks.zeros_matter [--seeds 20] [--trials 20] [--quick]

A seed is a robot: zeros of both arms (normal, 1° rms by joint), true mounts of the cameras. It takes 15 samples by
rendered images of each of three sets: the camera over the table with a board in either hand, the camera on a hand with
one on the table. *Without*: the cameras are calibrated with the joints as described, from the same samples. Errors of
a tool centre point are those of where kinematics believe it, at 200 random postures an arm, against the truth: in the
base frame, and as the camera over the table would have it, which is what a grasp depends on (a turn of base and camera
together moves nothing). Trials place an object with each arm in physics, depth with noise, by the same mounts.
"""

from __future__ import annotations

import argparse
import math
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.report import Row, write_report
from openarm_calibration.handeye.offline import calibrate
from openarm_calibration.handeye.solve import SolveConfig
from openarm_calibration.handeye.zero_sets import calibrate_zeros
from openarm_calibration.sampling.samples import SampleSet
from openarm_common import se3
from openarm_common.camera.cameras import load_cameras, true_mount, uncertain_cameras
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_name
from openarm_common.robot.zeros import ZEROS, Zeros, keep_zeros
from openarm_common.scene.scene import random_scene
from openarm_common.types import Array
from openarm_evaluation.campaign.mounts import Bench
from openarm_evaluation.campaign.parameters import suite_config
from openarm_evaluation.campaign.robot import Known, SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_sim_bridge.world.hardware import HardwareConfig, drawn

RMS_DEG = 1.0
SETS = ("mujoco_bridge.profile=openarm", f"mujoco_bridge.openarm.zero_rms={RMS_DEG}")
_POSTURES = 200


@dataclass(frozen=True, eq=False)
class Robot:
    """One draw: where joints are minus what they report, rad; its samples; the mounts by camera without zeros."""

    seed: int
    offsets: Mapping[str, float]
    sessions: list[SampleSet]
    mounts: Mapping[str, Array]


def made(seed: int) -> Robot:
    """Return the robot of a seed with its samples."""
    description, cameras = RobotDescription.load(), load_cameras()
    added = drawn(HardwareConfig(zero_rms=RMS_DEG).of_seed(seed), description).zero
    sessions: list[SampleSet] = []
    mounts: dict[str, Array] = {}
    for name in uncertain_cameras():
        camera = cameras[name]
        for arm in ("",) if description.arm_of(camera.parent) else description.arm_names:
            bench = Bench(camera, seed, added, arm)
            bench.fill(np.random.default_rng([seed, len(sessions)]))
            sessions.append(bench.samples)
        # by the usual limits it would be refused, for zeros that are off
        lax = SolveConfig(most_translation=1.0, most_rotation=1.0)
        mounts[name] = calibrate(sessions[-1], config=lax).calibration.T_parent_link
    return Robot(seed, {name: -value for name, value in added.items()}, sessions, mounts)


def tcp_errors(robot: Robot, arm: str, belief: RobotDescription, mount: Array) -> tuple[Array, Array]:
    """Return the errors (n,) of a tool centre point in the base frame, and in the camera over the table, m.

    Args:
        robot: The truth.
        arm: Which.
        belief: The robot as the suite has it.
        mount: T_parent_link of the camera over the table as the suite has it.
    """
    truth, camera = RobotDescription.load().described, load_cameras()[_over_table()]
    names = truth.arm_joints(arm)
    lower, upper = truth.limits(names)
    rng = np.random.default_rng([robot.seed, 7])
    true_camera = true_mount(camera, robot.seed)
    base, seen = np.zeros(_POSTURES), np.zeros(_POSTURES)
    for k in range(_POSTURES):
        q = dict.fromkeys(truth.joints, 0.0) | dict(zip(names, rng.uniform(lower, upper).tolist(), strict=True))
        reported = q | {name: q[name] - robot.offsets[name] for name in names}
        tips = truth.link_pose(truth.tcp_link(arm), q)[:3, 3], belief.link_pose(truth.tcp_link(arm), reported)[:3, 3]
        base[k] = np.linalg.norm(tips[1] - tips[0])
        parent = truth.link_pose(camera.parent, q)
        views = [
            se3.apply(se3.inverse(parent @ at), tip[None])[0]
            for at, tip in zip((true_camera, mount), tips, strict=True)
        ]
        seen[k] = np.linalg.norm(views[1] - views[0])
    return base, seen


def _over_table() -> str:
    description, cameras = RobotDescription.load(), load_cameras()
    return next(name for name in uncertain_cameras() if not description.arm_of(cameras[name].parent))


@contextmanager
def in_use(offsets: Mapping[str, float]) -> Iterator[None]:
    """Let this process have zeros of the joints, rad by name."""
    with tempfile.TemporaryDirectory() as folder:
        os.environ[ZEROS] = str(keep_zeros(Zeros(robot=robot_name(), offsets=dict(offsets)), Path(folder)))
        try:
            yield
        finally:
            del os.environ[ZEROS]


def place(seed: int, arm: str, mounts: Mapping[str, Array]) -> tuple[bool, float]:
    """Place an object on the side of an arm; return whether it was placed at the first attempt, and how far off, m."""
    side = RobotDescription.load().described.link_pose(
        RobotDescription.load().arm(arm).base, dict.fromkeys(RobotDescription.load().joints, 0.0)
    )[1, 3]
    scenes = (random_scene(1000 * seed + k, count=1) for k in range(1000))
    scene = next(one for one in scenes if side * one.objects[0].position[1] > 0.04 * abs(side))
    task = Task("zeros", seed, scene, (scene.objects[0].label,), arm=arm, mount_seed=seed, dynamics_seed=seed)
    row = Trials(task, SimulatedSenses(sets=SETS), suite_config(SETS).grasp, Known(mounts)).run()
    error = row["place_error_mm"]
    print(f"seed {seed:2d} {arm:5s} {row['outcome']}, attempts {row['attempts']}, {error} mm {row['code']}", flush=True)
    return row["placed"] and row["attempts"] == 1, math.nan if error is None else error * 1e-3


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20, help="how many robots")
    parser.add_argument("--trials", type=int, default=20, help="of how many of them objects are placed")
    parser.add_argument("--first", type=int, default=1, help="seed of the first")
    parser.add_argument("--quick", action="store_true", help="3 robots, 1 of them places objects")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    seeds, trials = (3, 1) if arguments.quick else (arguments.seeds, arguments.trials)
    description = RobotDescription.load()
    tcp: dict[tuple[str, str, str], list[Array]] = {}
    found_off: list[float] = []
    observable = 0
    placed: dict[tuple[str, str], list[tuple[bool, float]]] = {}
    for seed in range(arguments.first, arguments.first + seeds):
        robot = made(seed)
        found = calibrate_zeros(robot.sessions)
        after = {mount.camera: mount.T_parent_link for mount in found.mounts}
        belief = description.with_zeros(found.zeros.offsets)
        seen = [name for name in found.zeros.offsets if name not in found.zeros.by_prior]
        observable += len(seen)
        found_off += [found.zeros.offsets[name] - robot.offsets[name] for name in seen]
        worst = max((abs(found.zeros.offsets[name] - robot.offsets[name]) for name in seen), default=math.nan)
        line = [f"seed {seed:2d}: {len(seen)} zeros seen, worst {math.degrees(worst):.3f}°"]
        for arm in description.arm_names:
            for when, (body, mounts) in {"before": (description, robot.mounts), "after": (belief, after)}.items():
                base, camera = tcp_errors(robot, arm, body, mounts[_over_table()])
                tcp.setdefault((arm, when, "base"), []).append(base)
                tcp.setdefault((arm, when, "camera"), []).append(camera)
                line.append(f"{arm} {when} {np.median(base) * 1e3:.1f} {np.median(camera) * 1e3:.2f} mm")
        print("; ".join((*line, *found.failures, *found.warnings)), flush=True)
        if seed - arguments.first >= trials:
            continue
        for arm in description.arm_names:
            placed.setdefault((arm, "before"), []).append(place(seed, arm, robot.mounts))
            with in_use(found.zeros.offsets):
                placed.setdefault((arm, "after"), []).append(place(seed, arm, after))
    rows = [
        Row(
            "zeros_rms", math.degrees(float(np.sqrt(np.mean(np.square(found_off))))), "deg", "lower", 0.05, n=observable
        ),
        Row("zeros_seen", observable / seeds, "joints", "higher", None, n=seeds),
    ]
    for arm in description.arm_names:
        for frame in ("base", "camera"):
            now, peer = (float(np.median(np.concatenate(tcp[arm, w, frame]))) * 1e3 for w in ("after", "before"))
            rows.append(Row(f"zeros_tcp_{frame}_{arm}_p50", now, "mm", "lower", None, "without", peer, seeds))
        if (arm, "after") in placed:
            errors = {w: [e for _, e in placed[arm, w] if not math.isnan(e)] for w in ("after", "before")}
            first = {w: sum(ok for ok, _ in placed[arm, w]) for w in ("after", "before")}
            n = len(placed[arm, "after"])
            now, peer = (float(np.median(errors[w])) * 1e3 if errors[w] else math.nan for w in ("after", "before"))
            rows.append(Row(f"zeros_place_{arm}_p50", now, "mm", "lower", None, "without", peer, n))
            rows.append(
                Row(
                    f"zeros_first_attempt_{arm}",
                    first["after"] / n,
                    "",
                    "higher",
                    1.0,
                    "without",
                    first["before"] / n,
                    n,
                )
            )
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
