# SPDX-License-Identifier: Apache-2.0
"""Hand-eye calibration against its Cramér-Rao bound and every closed form of OpenCV in the same run.

    python benchmarks/calibration.py [--quick] [--trials N] [--json PATH]

Synthetic (see hand_eye_problems.py): 5, 10, 20, 30 poses; camera in the hand and over it; 0.1, 0.3 and 1.0 px;
an exact robot and one of 0.2 mm and 0.02° by axis. Each trial is solved with the noise known and with it estimated. A
ratio is the rms of the errors over their bounds, for the position and for the rotation of the camera.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import cv2
import numpy as np

from benchmarks import hand_eye_problems as synthetic
from benchmarks.report import Row, write_report
from openarm_calibration.handeye.closed_form import METHODS, closed_form
from openarm_calibration.handeye.problem import Setup
from openarm_calibration.handeye.solve import SolveConfig, solve
from openarm_calibration.handeye.transforms import difference
from openarm_calibration.handeye.unknowns import Noise
from openarm_common.errors import Code, OpenArmError
from openarm_common.types import Array

ROBOTS = {"exact": (0.0, 0.0), "0.2mm/0.02deg": (2e-4, math.radians(0.02))}
SETUPS: tuple[Setup, ...] = ("in_hand", "to_hand")


@dataclass
class Cell:
    """Errors of one kind of problem, by method: squares of position (m²) and rotation (rad²), and over the bound."""

    setup: Setup
    poses: int
    px: float
    robot: str
    bound: list[tuple[float, float]] = field(default_factory=list)
    error: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    relative: dict[str, list[tuple[float, float]]] = field(default_factory=dict)
    failed: dict[str, int] = field(default_factory=dict)
    nees: dict[str, list[float]] = field(default_factory=dict)
    ms: dict[str, list[float]] = field(default_factory=dict)

    def add(self, method: str, away: Array) -> None:
        """Count one error (6,), m and rad, of the trial whose bound came last."""
        squares = float(away[:3] @ away[:3]), float(away[3:] @ away[3:])
        self.error.setdefault(method, []).append(squares)
        bound = self.bound[-1]
        self.relative.setdefault(method, []).append((squares[0] / bound[0], squares[1] / bound[1]))

    def rms(self, method: str) -> tuple[float, float]:
        """Position in mm, rotation in degrees; NaN where the method never had an answer."""
        if not self.error.get(method):
            return math.nan, math.nan
        t, r = np.sqrt(np.mean(self.error[method], axis=0))
        return float(t) * 1e3, math.degrees(float(r))

    def ratio(self, method: str) -> tuple[float, float]:
        """Rms of each error over its own trial's bound, so that no single hard trial decides; on those it had."""
        if not self.relative.get(method):
            return math.nan, math.nan
        t, r = np.sqrt(np.mean(self.relative[method], axis=0))
        return float(t), float(r)


def run_cell(setup: Setup, poses: int, px: float, robot: str, trials: int, peer_trials: int) -> Cell:
    """Solve `trials` random problems; OpenCV's methods take the first `peer_trials` of them (up to 0.3 s each)."""
    cell = Cell(setup, poses, px, robot)
    noise = Noise(px, *ROBOTS[robot])
    rng = np.random.default_rng([SETUPS.index(setup), poses, round(px * 10), robot != "exact"])
    known = SolveConfig(
        px=px, robot_translation=noise.translation, robot_rotation=noise.rotation, reject_outliers=False,
        most_translation=1.0, most_rotation=3.0,
    )  # fmt: skip
    estimated = SolveConfig(most_translation=1.0, most_rotation=3.0)
    for k in range(trials):
        truth = synthetic.trial(setup, poses, noise, rng)
        bound = truth.bound(noise)
        cell.bound.append((float(np.trace(bound[:3, :3])), float(np.trace(bound[3:6, 3:6]))))
        for name, config in (("known", known), ("estimated", estimated)):
            begin = time.perf_counter()
            solution = solve(truth.problem, config)
            cell.ms.setdefault(name, []).append((time.perf_counter() - begin) * 1e3)
            away = difference(solution.estimate.X[0], truth.X)
            cell.add(name, away)
            cell.nees.setdefault(name, []).append(float(away @ np.linalg.solve(solution.mount_covariance(), away)))
        for method in METHODS if k < peer_trials else ():
            begin = time.perf_counter()
            try:
                X = closed_form(method, setup, truth.problem.A, truth.problem.free).X
            except OpenArmError:
                cell.failed[method] = cell.failed.get(method, 0) + 1
                continue
            cell.ms.setdefault(method, []).append((time.perf_counter() - begin) * 1e3)
            cell.add(method, difference(X, truth.X))
    return cell


def show(cell: Cell) -> None:
    """One line: errors in mm and degrees, ratios to the bound."""
    bound_t, bound_r = np.sqrt(np.mean(cell.bound, axis=0))
    parts = [f"{cell.setup:8s} N={cell.poses:<2d} {cell.px:.1f}px {cell.robot:13s}"]
    parts.append(f"bound {bound_t * 1e3:.3f}mm {math.degrees(bound_r):.4f}deg")
    for method in ("known", "estimated"):
        t, r = cell.ratio(method)
        parts.append(f"{method} x{t:.2f} x{r:.2f} nees {np.mean(cell.nees[method]):.1f}")
    for method in METHODS:
        t, _ = cell.rms(method)
        parts.append(f"{method} {t:.2f}mm x{cell.ratio(method)[0]:.1f}")
    print("  ".join(parts), flush=True)


def nearly_degenerate(trials: int) -> tuple[int, int, int]:
    """Random nearly degenerate sets of every kind: how many were refused, answered, and answered silently wrong.

    Silently wrong is a number that is not finite, or an error of more than six predicted standard deviations.
    """
    rng = np.random.default_rng(7)
    refused = wrong = 0
    for k in range(trials):
        kind, setup = synthetic.DEGENERATE[k % 4], SETUPS[k // 4 % 2]
        amount = 0.0 if k % 20 < 4 else math.radians(10.0 ** rng.uniform(-3.0, 1.0))
        truth = synthetic.degenerate(kind, setup, rng, amount, int(rng.integers(3, 13)))
        try:
            solution = solve(truth.problem)
        except OpenArmError as error:
            if error.code != Code.DEGENERATE:
                raise
            refused += 1
            continue
        away = difference(solution.estimate.X[0], truth.X)
        t, r = solution.sigma()
        right = np.linalg.norm(away[:3]) <= 6.0 * t and np.linalg.norm(away[3:]) <= 6.0 * r
        if not right:
            wrong += 1
            print(f"silently wrong: {kind} {setup} {math.degrees(amount):.3f}°, {away} against {t:.2e} m, {r:.2e} rad")
    return refused, trials - refused, wrong


def best_peer(cells: list[Cell]) -> tuple[str, float]:
    """The OpenCV method whose worst ratio is the smallest, and that ratio."""
    worst = {m: max(max(c.ratio(m)) for c in cells) for m in METHODS if all(c.error.get(m) for c in cells)}
    return min(worst.items(), key=lambda item: item[1])


def table(cells: list[Cell]) -> str:
    """Markdown of the rms errors, position in mm / rotation in degrees."""
    columns = [*METHODS, "refined"]
    lines = ["| camera | poses | px | robot | " + " | ".join(columns) + " | bound |"]
    lines.append("|" + "---|" * (len(columns) + 5))
    for cell in cells:
        bound_t, bound_r = np.sqrt(np.mean(cell.bound, axis=0))
        values = [cell.rms("estimated" if m == "refined" else m) for m in columns]
        text = " | ".join("-" if math.isnan(t) else f"{t:.2f} / {r:.3f}" for t, r in values)
        place = "in hand" if cell.setup == "in_hand" else "fixed"
        head = f"| {place} | {cell.poses} | {cell.px:g} | {cell.robot} | {text} "
        lines.append(head + f"| {bound_t * 1e3:.2f} / {math.degrees(bound_r):.3f} |")
    return "\n".join(lines)


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer poses, noises and trials; within two minutes")
    parser.add_argument("--trials", type=int, help="of a cell; 300, with --quick 100")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    parser.add_argument("--table", type=Path, help="where to write the errors as a Markdown table")
    arguments = parser.parse_args()
    trials = arguments.trials or (100 if arguments.quick else 300)
    counts, noises = ((5, 10), (0.3,)) if arguments.quick else ((5, 10, 20, 30), (0.1, 0.3, 1.0))
    cv2.setNumThreads(1)
    run_cell("in_hand", 5, 0.3, "exact", 2, 1)  # compiles
    cells: list[Cell] = []
    for setup in SETUPS:
        for poses in counts:
            for px in noises:
                for robot in ROBOTS:
                    peers = min(trials, 100 if poses <= 10 else 30)
                    cells.append(run_cell(setup, poses, px, robot, trials, peers))
                    show(cells[-1])
    peer, peer_ratio = best_peer(cells)
    rows = [
        Row(
            f"crlb_ratio_max_{kind}_noise", max(max(c.ratio(kind)) for c in cells), "", "lower", target,
            f"OpenCV {cv2.__version__} {peer}", peer_ratio, len(cells) * trials,
        )
        for kind, target in (("known", 1.15), ("estimated", 1.3))
    ]  # fmt: skip
    for kind, metric in (("known", "nees"), ("estimated", "nees_estimated_noise")):
        means = [float(np.mean(c.nees[kind])) for c in cells]
        farthest = max(means, key=lambda value: abs(value - 6.0))
        rows.append(Row(metric, farthest, "", "in 5..7", 6.0, n=len(cells) * trials))
        print(f"{metric}: mean {np.mean(means):.2f}, cells from {min(means):.2f} to {max(means):.2f}")
    middle = [c for c in cells if c.poses == max(counts)]
    ms = [value for c in middle for value in c.ms["estimated"]]
    peer_ms = [value for c in middle for value in c.ms.get("PARK", ())]
    rows.append(
        Row(
            "solve_ms", float(np.median(ms)), "ms", "lower", None, f"OpenCV {cv2.__version__} PARK",
            float(np.median(peer_ms)) if peer_ms else None, len(ms),
        )
    )  # fmt: skip
    sets = 200 if arguments.quick else 1000
    refused, answered, wrong = nearly_degenerate(sets)
    print(f"nearly degenerate sets: {refused} refused by name, {answered} answered, {wrong} of these silently wrong")
    rows.append(Row("degenerate_silent", wrong, "", "lower", 0.0, n=sets))
    write_report(rows, arguments.json)
    if arguments.table:
        arguments.table.write_text(table(cells) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
