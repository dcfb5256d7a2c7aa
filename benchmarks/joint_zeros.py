# SPDX-License-Identifier: Apache-2.0
"""Zeros of the joints of both arms, found with all mounts from synthetic sets with a known answer.

    python -m benchmarks.joint_zeros [--sets 200] [--quick]

A set: the camera over the table sees a board in each hand, the camera on the right hand a board on the table, 15 views
each at random postures. Zeros are off by 1° (normal, by joint), marks by 0.1 px, the hand by 0.1 mm and 0.01° by axis
from pose to pose. Printed are, joint by joint, the error and what was predicted, and the normalised square of the error
of groups of six (6: honest): the mounts, and the joints of each arm that a mount does not take up.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.report import Row, write_report
from openarm_calibration.board.board import CircleGrid
from openarm_calibration.handeye.marks import project
from openarm_calibration.handeye.problem import BoardView, Setup
from openarm_calibration.handeye.solve import SolveConfig
from openarm_calibration.handeye.transforms import moved, skews
from openarm_calibration.handeye.unknowns import Noise
from openarm_calibration.handeye.zeros import ArmView, ZerosConfig, ZerosResult, solve_zeros
from openarm_common import se3
from openarm_common.camera.cameras import T_LINK_OPTICAL, CameraConfig, load_cameras, true_mount
from openarm_common.draws import until
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

BOARD = CircleGrid()
OFF = math.radians(1.0)
NOISE = Noise(0.1, 1e-4, math.radians(0.01))
#: Camera, arm, set-up.
SETS: tuple[tuple[str, str, Setup], ...] = (
    ("overhead", "right", "to_hand"), ("overhead", "left", "to_hand"), ("wrist", "right", "in_hand"),
)  # fmt: skip


def postures(
    description: RobotDescription, spec: CameraConfig, arm: str, setup: Setup, count: int, rng: np.random.Generator,
    zeros: Mapping[str, float], noise: Noise, mount_seed: int,
) -> tuple[list[ArmView], Array, Array]:  # fmt: skip
    """Return views of a set, without numbers of camera and board, and the true X and Z.

    Args:
        description: Any robot.
        spec: Its camera.
        arm: That moves.
        setup: in_hand or to_hand.
        count: Views.
        rng: Of everything random.
        zeros: Offsets by joint, rad.
        noise: Standard deviations.
        mount_seed: Seed of the true mount of the camera.
    """
    k = spec.intrinsics
    row, size = np.array([k.fx, k.fy, k.cx, k.cy]), (k.width, k.height)
    tip = spec.parent if setup == "in_hand" else description.arm(arm).flange
    base = description.root if setup == "in_hand" else spec.parent
    names = list(description.arm_joints(arm))
    home = description.group_state(f"{arm}_arm", "home")
    middle = np.array([home[name] for name in names])
    lower, upper = description.limits(names)

    def pose(q: Array) -> Array:
        at = {name: value + zeros[name] for name, value in zip(names, q.tolist(), strict=True)}
        return se3.inverse(description.link_pose(base, at)) @ description.link_pose(tip, at)

    X = true_mount(spec, mount_seed) @ T_LINK_OPTICAL
    seen = se3.make(se3.rot_x(0.3) @ se3.rot_z(0.2), (0.0, 0.0, 0.36 if setup == "in_hand" else 0.6))
    A = pose(middle)
    Z = A @ X @ seen if setup == "in_hand" else se3.inverse(A) @ X @ seen
    out: list[ArmView] = []
    what = f"views of {spec.name} of the whole board"
    for _ in until(lambda: len(out) >= count, what, "take another mount", 10_000 * count):
        q = np.clip(middle + rng.uniform(-1.0, 1.0, len(names)) * rng.uniform(0.2, 0.9), lower, upper)
        error = rng.normal(0.0, 1.0, 6) * np.repeat((noise.translation, noise.rotation), 3)
        A = moved(pose(q), error)
        T = se3.inverse(X) @ (se3.inverse(A) if setup == "in_hand" else A) @ Z
        if not T[2, 2] > 0.5:
            continue
        pixels = project(BOARD.points, BOARD.radius, T, row)
        if not ((pixels > 8.0) & (pixels < np.array(size) - 8.0)).all():
            continue
        pixels = pixels + rng.normal(0.0, noise.px, pixels.shape)
        view = BoardView(BOARD.points, pixels, A, setup, BOARD.radius, name=f"{spec.name}_{arm}_{len(out):02d}")
        out.append(ArmView(view, base, tip, dict(zip(names, q.tolist(), strict=True)), T))
    return out, X, Z


@dataclass(frozen=True, eq=False)
class Trial:
    """Views of all sets, and the answer: zeros by joint, rad, mounts X of the cameras and Z of the boards."""

    views: list[ArmView]
    zeros: dict[str, float]
    X: list[Array]
    Z: list[Array]
    cameras: tuple[str, ...]


def trial(
    description: RobotDescription, rng: np.random.Generator, count: int = 15, off: float = OFF, noise: Noise = NOISE
) -> Trial:
    """Return a random problem.

    Args:
        description: The robot.
        rng: Of everything random.
        count: Views of each set.
        off: Standard deviation of a zero, rad.
        noise: Standard deviations.
    """
    zeros = {name: float(rng.normal(0.0, off)) for arm in ("right", "left") for name in description.arm_joints(arm)}
    seed, known = int(rng.integers(1, 1000)), load_cameras()
    cameras = tuple(dict.fromkeys(camera for camera, _, _ in SETS))
    X: dict[str, Array] = {}
    views: list[ArmView] = []
    Z: list[Array] = []
    for board, (camera, arm, setup) in enumerate(SETS):
        own, X[camera], place = postures(description, known[camera], arm, setup, count, rng, zeros, noise, seed)
        Z.append(place)
        for k, taken in enumerate(own, len(views)):
            numbered = replace(taken.view, camera=cameras.index(camera), board=board, pose=k)
            views.append(replace(taken, view=numbered))
    return Trial(views, zeros, [X[camera] for camera in cameras], Z, cameras)


def solved(description: RobotDescription, made: Trial, sigma: float = OFF) -> ZerosResult:
    """Return the zeros of a problem."""
    known = load_cameras()
    config = ZerosConfig(sigma=sigma, solver=SolveConfig(most_translation=10.0, most_rotation=10.0))
    return solve_zeros(description, made.views, [known[name].intrinsics for name in made.cameras], config)


def _twist(T: Array) -> Array:
    """Return the twist (6,) whose exponential is a transform: translation, rotation."""
    w = se3.log_so3(T[:3, :3])
    angle = max(float(np.linalg.norm(w)), 1e-9)
    K = skews(w)
    V = np.eye(3) + (1.0 - math.cos(angle)) / angle**2 * K + (angle - math.sin(angle)) / angle**3 * K @ K
    return np.concatenate([np.linalg.solve(V, T[:3, 3]), w]).astype(np.float64)


def groups(found: ZerosResult, made: Trial) -> dict[str, float]:
    """Return the normalised square of the error of groups of six."""
    estimate = found.solution.estimate
    covariance, first = estimate.covariance(), len(estimate.information) - len(found.names)
    out: dict[str, float] = {}

    def add(name: str, error: Array, columns: list[int]) -> None:
        out[name] = float(error @ np.linalg.solve(covariance[np.ix_(columns, columns)], error))

    for k, camera in enumerate(made.cameras):
        # a turn about the first or last joint moves the mount along a circle: counted as a twist, in which it is linear
        block, X = slice(6 * k, 6 * k + 6), estimate.X[k]
        to_twist = np.block([[np.eye(3), skews(X[:3, 3]) @ X[:3, :3]], [np.zeros((3, 3)), X[:3, :3]]])
        twist = _twist(made.X[k] @ se3.inverse(X))
        out[f"mount_{camera}"] = float(twist @ np.linalg.solve(to_twist @ covariance[block, block] @ to_twist.T, twist))
    away = dict(zip(found.names, found.values - [made.zeros[name] for name in found.names], strict=True))
    for arm in ("right", "left"):
        names = [name for name in found.names if f"_{arm}_" in name][1:]
        columns = [first + found.names.index(name) for name in names]
        add(f"joints_{arm}_2_to_7", np.array([away[name] for name in names]), columns)
    return out


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sets", type=int, help="how many; 200, with --quick 20")
    parser.add_argument("--quick", action="store_true", help="20 sets")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    sets = arguments.sets or (20 if arguments.quick else 200)
    description = RobotDescription.load()
    away: dict[str, list[float]] = {}
    sigma: dict[str, list[float]] = {}
    observable: dict[str, list[bool]] = {}
    nees: dict[str, list[float]] = {}
    seconds: list[float] = []
    for number in range(sets):
        made = trial(description, np.random.default_rng([22, number]))
        begin = time.thread_time()
        found = solved(description, made)
        seconds.append(time.thread_time() - begin)
        for name, value, deviation, seen in zip(found.names, found.values, found.sigma, found.observable, strict=True):
            away.setdefault(name, []).append(value - made.zeros[name])
            sigma.setdefault(name, []).append(deviation)
            observable.setdefault(name, []).append(seen)
        for name, value in groups(found, made).items():
            nees.setdefault(name, []).append(value)
    seen_errors: list[float] = []
    for name, errors in away.items():
        rms, predicted = math.degrees(np.sqrt(np.mean(np.square(errors)))), math.degrees(np.mean(sigma[name]))
        observable_in = sum(observable[name])
        seen_errors += [error for error, seen in zip(errors, observable[name], strict=True) if seen]
        print(f"{name:24s} rms {rms:.4f}°  predicted {predicted:.4f}°  observable in {observable_in} of {sets} sets")
    for name, values in nees.items():
        print(f"nees {name:24s} {np.mean(values):.2f}")
    worst = max((float(np.mean(values)) for values in nees.values()), key=lambda value: abs(value - 6.0))
    rms_seen = math.degrees(np.sqrt(np.mean(np.square(seen_errors))))
    rows = [
        Row("zeros_rms", rms_seen, "deg", "lower", 0.05, n=len(seen_errors)),
        Row("zeros_nees", worst, "", "in 5..7", 6.0, n=sets),
        Row("zeros_solve", float(np.median(seconds)), "s", "lower", None, n=sets),
    ]  # fmt: skip
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
