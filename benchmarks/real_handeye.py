# SPDX-License-Identifier: Apache-2.0
"""Leave-one-out on sets of real robots: closed forms, the refinement without misfit and as chosen, joint zeros.

    python -m benchmarks.real_handeye FOLDER [--robot openarm_v1]

FOLDER holds a JSON file for each set, in SI units: `camera` (width, height, K), `setup` (eye_in_hand or eye_to_hand),
`chain` (base and tip link), and `samples`, each with `T_base_tip`, `corners_px`, `corners_board_m`, and, where joint
zeros can be estimated, `joint_positions`. The true mounts are not known: each view is left out in turn and predicted
by the answer of the others, in px, and in mm and degrees against the pose of its own corners.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.report import Row, write_report
from openarm_calibration.board.detect import guess_pose
from openarm_calibration.handeye.choice import solve_chosen
from openarm_calibration.handeye.closed_form import METHODS, closed_form
from openarm_calibration.handeye.left_out import column_squares
from openarm_calibration.handeye.marks import Indices
from openarm_calibration.handeye.problem import BoardView, Problem, Setup, assemble, chain
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.zeros import ArmView, ZerosResult, arm_problem, solve_zeros
from openarm_common.camera.cameras import Intrinsics
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.types import Array

_SETUPS: dict[str, Setup] = {"eye_in_hand": "in_hand", "eye_to_hand": "to_hand"}
_LAX = SolveConfig(most_translation=10.0, most_rotation=10.0)
_BEFORE = _LAX.model_copy(update={"misfit": False})


@dataclass(frozen=True, eq=False)
class RealSet:
    """A set, and the joints behind its poses; `arm` is empty where they are not known."""

    name: str
    problem: Problem
    arm: tuple[ArmView, ...]

    @property
    def setup(self) -> Setup:
        """Of its views."""
        return self.problem.views[0].setup


def read_set(path: Path) -> RealSet:
    """Read a JSON file of a set."""
    data: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    camera = data["camera"]
    K = np.array(camera["K"], dtype=np.float64).reshape(3, 3)
    optics = Intrinsics(camera["width"], camera["height"], K[0, 0], K[1, 1], K[0, 2], K[1, 2])
    distortion = np.array(camera.get("D", ()), dtype=np.float64)
    views: list[BoardView] = []
    guesses: list[Array] = []
    for number, sample in enumerate(data["samples"]):
        points = np.array(sample["corners_board_m"], dtype=np.float64)
        pixels = np.array(sample["corners_px"], dtype=np.float64)
        if distortion.any():
            pixels = cv2.undistortPoints(pixels[:, None], K, distortion, P=K)[:, 0].astype(np.float64)
        views.append(
            BoardView(
                points, pixels, np.array(sample["T_base_tip"]), _SETUPS[data["setup"]], pose=number, name=sample["id"]
            )
        )
        guesses.append(guess_pose(points, pixels, 0.0, optics)[0])
    arm = tuple(
        ArmView(view, data["chain"][0], data["chain"][1], sample["joint_positions"], guess)
        for view, sample, guess in zip(views, data["samples"], guesses, strict=True)
        if sample.get("joint_positions")
    )
    return RealSet(path.stem, assemble(views, [optics], guesses), arm)


def _poses(problem: Problem, X: Array, Z: Array) -> Array:
    return chain(problem, X[None] if X.ndim == 2 else X, Z[None] if Z.ndim == 2 else Z)[0]


def fit_closed(real: RealSet, keep: Indices, method: str) -> Array:
    """Answer with a closed form of the views `keep`."""
    part = real.problem.subset(keep)
    mounts = closed_form(method, real.setup, part.A, part.free)
    return _poses(real.problem, mounts.X, mounts.Z)


def fit_solver(real: RealSet, keep: Indices, config: SolveConfig) -> Array:
    """Answer with the solver."""
    answer = solve_chosen if config.misfit else solve
    estimate = answer(real.problem.subset(keep), config).estimate
    return _poses(real.problem, estimate.X, estimate.Z)


def zeros_of(real: RealSet, keep: Indices, description: RobotDescription) -> ZerosResult:
    """Return the zeros by the views `keep`."""
    return solve_zeros(description, [real.arm[i] for i in keep], real.problem.intrinsics)


def fit_zeros(real: RealSet, keep: Indices, description: RobotDescription) -> Array:
    """Answer with zeros, where the views show that they are off."""
    found = zeros_of(real, keep, description)
    if not found.off:
        return fit_solver(real, keep, _LAX)
    estimate = found.solution.estimate
    whole = arm_problem(description, real.arm, real.problem.intrinsics, found.names).posed(found.values)
    return _poses(whole, estimate.X, estimate.Z)


def left_out(real: RealSet, fit: Callable[[Indices], Array]) -> Array:
    """Return (n, 3) errors of each view, predicted by the others: px rms, m at the board's centre, rad."""
    problem = real.problem
    out: list[Array] = []
    for i in range(len(problem)):
        try:
            T = fit(np.array([k for k in range(len(problem)) if k != i]))
        except OpenArmError:
            out.append(np.full(3, math.nan))
            continue
        one = problem.subset([i])
        out.append(np.sqrt(column_squares(one, T[i : i + 1])[0]))
    return np.array(out)


def show(name: str, errors: Array, seconds: float) -> None:
    """Print a row."""
    px = errors[:, 0]
    mm, degrees = errors[:, 1] * 1e3, np.degrees(errors[:, 2])
    print(
        f"  {name:16s} px median {np.median(px):6.2f} rms {np.sqrt(np.mean(px**2)):6.2f}"
        f"   mm median {np.median(mm):6.2f} p95 {np.percentile(mm, 95):6.2f} rms {np.sqrt(np.mean(mm**2)):6.2f}"
        f"   deg median {np.median(degrees):5.2f} p95 {np.percentile(degrees, 95):5.2f}"
        f" rms {np.sqrt(np.mean(degrees**2)):5.2f}   {seconds:5.2f} s",
        flush=True,
    )


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--robot", default="openarm_v1", help="whose joints are in the sets")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    description = RobotDescription.from_folder(arguments.robot)
    rows: list[Row] = []
    for path in sorted(arguments.folder.glob("*.json")):
        real = read_set(path)
        print(f"{real.name}: {len(real.problem)} views, {real.setup}")
        answers: dict[str, Callable[[Indices], Array]] = {
            method: lambda keep, method=method, real=real: fit_closed(real, keep, method) for method in METHODS
        }
        answers["without misfit"] = lambda keep, real=real: fit_solver(real, keep, _BEFORE)
        answers["refined"] = lambda keep, real=real: fit_solver(real, keep, _LAX)
        if real.arm:
            answers["refined, zeros"] = lambda keep, real=real: fit_zeros(real, keep, description)
        rms: dict[str, Array] = {}
        for name, fit in answers.items():
            begin = time.thread_time()
            errors = left_out(real, fit)
            show(name, errors, time.thread_time() - begin)
            rms[name] = np.sqrt(np.mean(errors**2, axis=0))
        for column, (unit, factor) in enumerate((("px", 1.0), ("mm", 1e3), ("deg", math.degrees(1.0)))):
            peer = min(METHODS, key=lambda m: float(np.nan_to_num(rms[m][column], nan=math.inf)))
            for name in list(answers)[len(METHODS) :]:
                metric = f"{real.name}_{name.replace(', ', '_').replace(' ', '_')}_loo_{unit}"
                rows.append(
                    Row(
                        metric, float(rms[name][column] * factor), unit, "lower", None, peer,
                        float(rms[peer][column] * factor), len(real.problem),
                    )
                )  # fmt: skip
        whole = solve(real.problem, _LAX).estimate.noise
        print(f"  noise: {whole}")
        if real.arm:
            found = zeros_of(real, np.arange(len(real.problem)), description)
            print("  " + "\n  ".join(found.sentences()))
            print(f"  noise: {found.solution.estimate.noise}")
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
