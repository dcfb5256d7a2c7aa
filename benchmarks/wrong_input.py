# SPDX-License-Identifier: Apache-2.0
"""Wrong input of twelve kinds: is it named, and is nothing wrong stored?

    python -m benchmarks.wrong_input [--sets 50] [--kinds board_size ...] [--seed 0] [--json PATH]
    python -m benchmarks.wrong_input --robots openarm_v1 panda [--kinds right ...]

Synthetic sets with a known answer (`hand_eye_problems`), marks off by 0.3 px, the robot by 0.2 mm and 0.02° by axis,
of 10 and of 25 views. A set counts as named when the first cause in the verdict, or in the refusal, is what is wrong
with it, and as silently wrong when its grade would let it be stored with a mount that is off by more than three times
the limit of a pass and by more than four predicted deviations. `right` are sets without a mistake: named is then the
share in which no cause is.

With `--robots` the sets are of arms whose joint zeros are off by 0.05° to 0.3° rms, as those of any arm are: `right`
then says that zeros are not mistaken for another cause. Mistakes in the poses are left out, since joints have none, and
so is what is silently wrong: zeros alone move the mount, and only `calibrate zeros` finds them.
"""

from __future__ import annotations

import argparse
import math
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import hand_eye_problems as synthetic
from benchmarks.hand_eye_problems import Truth
from benchmarks.joint_zeros import postures
from benchmarks.report import Row, write_report
from openarm_calibration.board.detect import guess_pose
from openarm_calibration.handeye.problem import Problem, Setup, assemble
from openarm_calibration.handeye.refine import mount_error
from openarm_calibration.handeye.solve import solve
from openarm_calibration.handeye.transforms import inverses, moved
from openarm_calibration.handeye.unknowns import Noise
from openarm_calibration.handeye.verdict import Limits, assess
from openarm_calibration.handeye.zeros import arm_problem
from openarm_common.camera.cameras import Intrinsics, load_cameras
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder
from openarm_common.types import Array

NOISE = Noise(0.3, 2e-4, math.radians(0.02))
SIZES = (10, 25)
Spoil = Callable[[Truth, np.random.Generator], Problem]


def _poses(problem: Problem, A: Array) -> Problem:
    return replace(problem, views=tuple(replace(v, A=a) for v, a in zip(problem.views, A, strict=True)), A=A)


def _again(problem: Problem, views: list, optics: Intrinsics) -> Problem:  # type: ignore[type-arg]
    """Return the problem of changed marks or intrinsics, with guesses of the poses as a session has them."""
    guesses = [guess_pose(view.points, view.pixels, view.radius, optics)[0] for view in views]
    return assemble(views, [optics], guesses)


def _optics(truth: Truth, **change: float) -> Problem:
    k = truth.problem.intrinsics[0]
    wrong = replace(k, **{name: getattr(k, name) + value for name, value in change.items()})
    return _again(truth.problem, list(truth.problem.views), wrong)


def board_size(truth: Truth, rng: np.random.Generator) -> Problem:
    """Stated 3 % small or large."""
    s = 1.0 + rng.choice([-1.0, 1.0]) * 0.03
    views = [replace(view, points=view.points * s, radius=view.radius * s) for view in truth.problem.views]
    return _again(truth.problem, views, truth.problem.intrinsics[0])


def focal_length(truth: Truth, rng: np.random.Generator) -> Problem:
    """Stated 1 to 3 % short or long."""
    off = truth.problem.intrinsics[0].fx * rng.choice([-1.0, 1.0]) * rng.uniform(0.01, 0.03)
    return _optics(truth, fx=off, fy=off)


def principal_point(truth: Truth, rng: np.random.Generator) -> Problem:
    """Stated 10 px off."""
    angle = rng.uniform(0.0, math.tau)
    return _optics(truth, cx=10.0 * math.cos(angle), cy=10.0 * math.sin(angle))


def distortion(truth: Truth, rng: np.random.Generator) -> Problem:
    """k1 of 0.1 either way, stated as none."""
    k, k1 = truth.problem.intrinsics[0], 0.1 * rng.choice([-1.0, 1.0])
    centre, focal = np.array([k.cx, k.cy]), np.array([k.fx, k.fy])
    views = []
    for view in truth.problem.views:
        x = (view.pixels - centre) / focal
        views.append(replace(view, pixels=x * (1.0 + k1 * np.sum(x**2, axis=1, keepdims=True)) * focal + centre))
    return _again(truth.problem, views, k)


def delay(truth: Truth, rng: np.random.Generator) -> Problem:
    """Images 30 ms old, of an arm that moves at 0.1 m/s and 0.3 rad/s by axis."""
    rate = rng.normal(0.0, 1.0, (len(truth.problem), 6)) * np.repeat((0.1, 0.3), 3)
    A = moved(truth.problem.A, rate * 0.03)
    views = tuple(replace(v, A=a, rate=r) for v, a, r in zip(truth.problem.views, A, rate, strict=True))
    return replace(truth.problem, views=views, A=A, rate=rate)


def outliers(truth: Truth, rng: np.random.Generator) -> Problem:
    """Every fifth robot pose off by some 20 mm and 3° by axis."""
    A = truth.problem.A.copy()
    wrong = rng.choice(len(A), len(A) // 5, replace=False)
    A[wrong] = moved(A[wrong], rng.normal(0.0, 1.0, (len(wrong), 6)) * np.repeat((0.02, 0.05), 3))
    return _poses(truth.problem, A)


def wrong_board(truth: Truth, rng: np.random.Generator) -> Problem:
    """Rows 5 % off their stated distance, or marks in the order of another board."""
    views = list(truth.problem.views)
    if rng.random() < 0.5:
        stretch = np.array([1.0, 1.0 + rng.choice([-1.0, 1.0]) * 0.05, 1.0])
        views = [replace(view, points=view.points * stretch) for view in views]
    else:
        other = truth.problem.views[0].points.reshape(11, 4, 3).swapaxes(0, 1).reshape(-1, 3)
        views = [replace(view, points=other) for view in views]
    return _again(truth.problem, views, truth.problem.intrinsics[0])


def setup(truth: Truth, _: np.random.Generator) -> Problem:
    """Eye-in-hand given as eye-to-hand, or the reverse."""
    other: Setup = "to_hand" if truth.problem.views[0].setup == "in_hand" else "in_hand"
    views = [replace(view, setup=other) for view in truth.problem.views]
    return _again(truth.problem, views, truth.problem.intrinsics[0])


def mirrored_or_swapped(truth: Truth, rng: np.random.Generator) -> Problem:
    """One axis of the robot's frame reversed, or the poses in another order than the images."""
    A = truth.problem.A
    if rng.random() < 0.5:
        flip = np.ones(4)
        flip[rng.integers(3)] = -1.0
        return _poses(truth.problem, np.diag(flip) @ A @ np.diag(flip))
    return _poses(truth.problem, np.roll(A, 1, axis=0) if rng.random() < 0.5 else A[::-1].copy())


def degrees(truth: Truth, rng: np.random.Generator) -> Problem:
    """Rotation vectors in degrees read as radians, or the reverse."""
    A = truth.problem.A.copy()
    w = Rotation.from_matrix(A[:, :3, :3]).as_rotvec()
    w = np.degrees(w) if rng.random() < 0.5 else np.radians(w)
    A[:, :3, :3] = Rotation.from_rotvec(w).as_matrix()
    return _poses(truth.problem, A)


def millimetres(truth: Truth, _: np.random.Generator) -> Problem:
    """Positions of the robot in millimetres read as metres."""
    A = truth.problem.A.copy()
    A[:, :3, 3] *= 1e3
    return _poses(truth.problem, A)


def inverted(truth: Truth, _: np.random.Generator) -> Problem:
    """T_tip_base for T_base_tip."""
    return _poses(truth.problem, inverses(truth.problem.A))


def right(truth: Truth, _: np.random.Generator) -> Problem:
    """No mistake."""
    return truth.problem


#: Mistakes that a set of joint positions can have as well.
OF_JOINTS: tuple[Spoil, ...] = (board_size, focal_length, principal_point, distortion, wrong_board, right)


def synthetic_set(count: int, rng: np.random.Generator) -> Truth:
    """Return a set of an arm of which the poses alone are known."""
    return synthetic.trial(("in_hand", "to_hand")[int(rng.integers(2))], count, NOISE, rng)  # type: ignore[arg-type]


def robot_set(robot: str, count: int, rng: np.random.Generator) -> Truth:
    """Return a set of joint positions, with zeros that are off by 0.05° to 0.3° rms.

    Args:
        robot: Name of its folder.
        count: Views.
        rng: Of everything random.
    """
    folder, parts = load_folder(robot)
    cameras = [spec for spec in load_cameras(folder / parts.cameras).values() if spec.depth]
    description = RobotDescription.load(robot)
    spec = cameras[int(rng.integers(len(cameras)))]
    carrier = description.arm_of(spec.parent)
    arm = carrier or str(rng.choice(description.arm_names))
    off = math.radians(rng.uniform(0.05, 0.3))
    zeros = {name: float(rng.normal(0.0, off)) for name in description.arm_joints(arm)}
    setup: Setup = "in_hand" if carrier else "to_hand"
    seed = int(rng.integers(1, 1000))
    taken, X, Z = postures(description, spec, arm, setup, count, rng, zeros, NOISE, seed)
    numbered = [replace(one, view=replace(one.view, pose=k)) for k, one in enumerate(taken)]
    names = description.arm_joints(arm)
    problem = arm_problem(description, numbered, [spec.intrinsics], names).posed(np.zeros(len(names)))
    views = tuple(replace(view, A=A) for view, A in zip(problem.views, problem.A, strict=True))
    return Truth(replace(problem, views=views), X, Z, np.array([one.view.A for one in taken]))


#: Kind, and what its name begins with; the set-up and inverted poses are one and the same in the data.
KINDS: dict[Spoil, str] = {
    board_size: "the board seems", focal_length: "the focal length seems", principal_point: "the principal point seems",
    distortion: "the images seem distorted", delay: "the images seem .* old", outliers: "contradict",
    wrong_board: "the (marks (don't lie|have no)|rows of the board)", setup: "the poses fit the other way round",
    mirrored_or_swapped: "the poses (are mirrored|belong to other images)", degrees: "the rotations are",
    millimetres: "the positions of the robot are in millimetres", inverted: "the poses fit the other way round",
    right: "",
}  # fmt: skip


@dataclass
class Tally:
    """Of one kind and size."""

    named: int = 0
    silent: int = 0
    grades: dict[str, int] | None = None
    said: dict[str, int] | None = None
    seconds: float = 0.0


def judge(kind: Spoil, truth: Truth, rng: np.random.Generator, tally: Tally) -> None:
    """Count one set.

    Args:
        kind: What is wrong with it.
        truth: The set without it.
        rng: Of everything random.
        tally: To count in.
    """
    limits = Limits()
    begin = time.thread_time()
    try:
        problem = kind(truth, rng)
        solution = solve(problem)
        verdict = assess(problem, solution, limits)
    except OpenArmError as error:
        grade, said, away, sigma = "refused", error.message, (0.0, 0.0), (0.0, 0.0)
    else:
        grade = verdict.grade
        causes = verdict.figures["causes"]
        said = next((check.text for check in verdict.checks if causes and check.name == next(iter(causes))), "")
        if kind is outliers:
            said = "contradict" if solution.outliers else ""
        sigma = solution.sigma()
        away = mount_error(solution.estimate.X[0], truth.X)
    tally.seconds = max(tally.seconds, time.thread_time() - begin)
    tally.grades = tally.grades or {}
    tally.grades[grade] = tally.grades.get(grade, 0) + 1
    hit = grade != "refused" and not said if kind is right else bool(re.match(KINDS[kind], said))
    tally.named += hit
    if not hit:
        tally.said = tally.said or {}
        tally.said[said[:60]] = tally.said.get(said[:60], 0) + 1
    far = zip(away, (limits.translation, limits.rotation), sigma, strict=True)
    wrong = any(error > max(3.0 * limit, 4.0 * deviation) for error, limit, deviation in far)
    tally.silent += grade in ("pass", "warn") and wrong


def main() -> None:
    """Run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = {kind.__name__: kind for kind in KINDS}
    parser.add_argument("--sets", type=int, default=50, help="of each kind and size")
    parser.add_argument("--kinds", nargs="+", choices=list(names), default=list(names))
    parser.add_argument("--robots", nargs="+", default=[], help="sets of these robots, by joints")
    parser.add_argument("--seed", type=int, default=0, help="of the sets; others for development than for a report")
    parser.add_argument("--json", type=Path, help="where to write the metrics")
    arguments = parser.parse_args()
    kinds = [kind for kind in KINDS if kind.__name__ in arguments.kinds]
    sources: dict[str, Callable[[int, np.random.Generator], Truth]] = {"": synthetic_set}
    if arguments.robots:
        kinds = [kind for kind in kinds if kind in OF_JOINTS]
        sources = {f"{robot}_": partial(robot_set, robot) for robot in arguments.robots}
    rows: list[Row] = []
    for source, make in sources.items():
        for kind in kinds:
            for count in SIZES:
                name, tally = f"{source}{kind.__name__}", Tally()
                for k in range(arguments.sets):
                    rng = np.random.default_rng([list(names).index(kind.__name__), count, k + 1000 * arguments.seed])
                    judge(kind, make(count, rng), rng, tally)
                share = tally.named / arguments.sets * 100
                silent = "" if source else f"silently wrong {tally.silent}; "
                print(
                    f"{name:20s} {count:2d} views: named {share:5.1f} %, {silent}{tally.grades};"
                    f" slowest {tally.seconds:.2f} s; else {tally.said or {}}",
                    flush=True,
                )
                rows.append(Row(f"{name}_{count}_named", share, "%", "higher", 95.0, n=arguments.sets))
                if not source:
                    rows.append(Row(f"{name}_{count}_silent", tally.silent, "", "lower", 0.0, n=arguments.sets))
    write_report(rows, arguments.json)


if __name__ == "__main__":
    main()
