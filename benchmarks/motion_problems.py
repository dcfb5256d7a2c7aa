# SPDX-License-Identifier: Apache-2.0
"""Planning problems on a table, in a shelf and for both arms, drawn from seeds. Base frame, m, rad.

They stand where the process's robot works: on its table, as far from it as its region of objects begins.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.motion_map import rendered
from openarm_common import se3
from openarm_common.draws import until
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.folder import robot_work
from openarm_common.types import Array
from openarm_motion.collision.occupancy import NOTHING, Environment
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.planning.planner import Planner, PlanQuery

#: Whether configurations collide that are free of everything else is asked of this.
Collides = Callable[[Array], bool]

_WORK = robot_work()
_WAY_OUT = "take another seed, or a robot that reaches more"
TABLE_TOP, _NEAR = _WORK.table.top_z, _WORK.region.x[0]
_TRIES = 400
#: Table-top problems to a rendered map.
_A_MAP = 5
#: Seeds that the steps of the search were chosen on, and those that figures are reported of: never tuned on.
TUNING: Mapping[str, int] = {"table": 0, "shelf": 1, "dual": 2}
REPORTED: Mapping[str, int] = {"table": 61_000, "shelf": 62_000, "dual": 63_000}


@dataclass(frozen=True, eq=False)
class Problem:
    """One query: what is around the robot, a start (n,) and goals (k, n); `state` has all the robot's joints."""

    arm: str
    boxes: tuple[Box, ...]
    state: Mapping[str, float]
    start: Array
    goals: Array
    known: Environment = NOTHING


def table_boxes(rng: np.random.Generator, count: int = 8) -> tuple[Box, ...]:
    """Boxes that stand on the table, some of them over each other's edges."""
    sizes = rng.uniform([0.04, 0.04, 0.08], [0.10, 0.12, 0.25], (count, 3))
    x, y = rng.uniform(_NEAR + 0.12, _NEAR + 0.46, count), rng.uniform(-0.45, 0.45, count)
    return tuple(
        box_from(f"box{i}", (x[i], y[i], TABLE_TOP + 0.5 * sizes[i, 2] + 0.001), sizes[i]) for i in range(count)
    )


def shelf(rng: np.random.Generator) -> tuple[tuple[Box, ...], Array]:
    """A shelf of three by two cells on the table, open to the robot: its boards and the cells' middles (6, 3)."""
    thick, depth, height = 0.015, 0.22, float(rng.uniform(0.24, 0.30))
    x0 = _NEAR + 0.24 + float(rng.uniform(-0.02, 0.02))
    y = np.array([-0.48, -0.16, 0.16, 0.48]) + rng.uniform(-0.03, 0.03, 4)
    z0 = TABLE_TOP + 0.002
    width, middle = float(y[-1] - y[0]), float(0.5 * (y[-1] + y[0]))
    boards = [
        box_from(f"upright{i}", (x0 + depth / 2, yi, z0 + height), (depth, thick, 2 * height)) for i, yi in enumerate(y)
    ]
    boards += [box_from(f"board{k}", (x0 + depth / 2, middle, z0 + k * height), (depth, width, thick)) for k in (1, 2)]
    boards.append(box_from("back", (x0 + depth, middle, z0 + height), (thick, width, 2 * height)))
    cells = [(x0 + 0.10, 0.5 * (y[i] + y[i + 1]), z0 + (k + 0.5) * height) for i in range(3) for k in range(2)]
    return tuple(boards), np.array(cells)


def around_box(arm: Arm, box: Box, rng: np.random.Generator, collides: Collides, want: int = 4) -> list[Array]:
    """Free configurations with the hand 8 cm from a box, from above or from aside."""
    found: list[Array] = []
    for _ in range(20):
        yaw, tilt = rng.uniform(-math.pi, math.pi), rng.uniform(0.0, 0.5 * math.pi)
        R = se3.rot_z(yaw) @ se3.rot_x(math.pi - tilt)
        pose = se3.make(R, box.T[:3, 3] - R[:, 2] * (0.08 + 0.5 * float(box.size.max())))
        found += _free(arm, pose, rng, collides, 2)
        if len(found) >= want:
            break
    return found[:want]


def in_cell(arm: Arm, cell: Array, rng: np.random.Generator, collides: Collides, want: int = 4) -> list[Array]:
    """Free configurations with the hand in a cell of the shelf."""
    found: list[Array] = []
    for _ in range(40):
        yaw, pitch, roll = rng.uniform(-0.7, 0.7), 0.5 * math.pi + rng.uniform(-0.5, 0.5), rng.uniform(-np.pi, np.pi)
        R = se3.rot_z(yaw) @ se3.rot_y(pitch) @ se3.rot_z(roll)
        found += _free(arm, se3.make(R, cell + rng.uniform(-0.03, 0.03, 3)), rng, collides, 2)
        if len(found) >= want:
            break
    return found[:want]


def table_problems(arms: Sequence[Arm], home: Mapping[str, float], count: int, seed: int) -> list[Problem]:
    """From a random free configuration to one of several next to a box that only the map knows; the arms take turns."""
    rng = np.random.default_rng(seed)
    out: list[Problem] = []
    what = f"problems {seed}: a free configuration and one next to a box"
    for _ in until(lambda: len(out) >= count, what, _WAY_OUT, 100 * count):
        boxes = table_boxes(rng)
        known = rendered(arms[0], home, boxes, int(rng.integers(2**31)))
        for _ in range(min(_A_MAP, count - len(out))):
            arm = arms[len(out) % len(arms)]
            collides = arm.scene(home, environment=known).collides
            goals = around_box(arm, boxes[int(rng.integers(len(boxes)))], rng, collides)
            if goals:
                out.append(Problem(arm.name, (), home, random_free(arm, rng, collides), np.array(goals), known))
    return out


def shelf_problems(arms: Sequence[Arm], home: Mapping[str, float], count: int, seed: int) -> list[Problem]:
    """From one cell of a shelf into another one; the arms take turns."""
    rng = np.random.default_rng(seed)
    out: list[Problem] = []
    what = f"problems {seed}: a free configuration in each of two cells"
    for _ in until(lambda: len(out) >= count, what, _WAY_OUT, 100 * count):
        arm = arms[len(out) % len(arms)]
        boards, cells = shelf(rng)
        # the other arm is where it hangs clear of the shelf
        state = dict.fromkeys(home, 0.0)
        collides = arm.scene(state, boards).collides
        a, b = rng.choice(len(cells), 2, replace=False)
        starts, goals = in_cell(arm, cells[a], rng, collides, 1), in_cell(arm, cells[b], rng, collides)
        if starts and goals:
            out.append(Problem(arm.name, boards, state, starts[0], np.array(goals)))
    return out


def dual_problems(both: DualArm, home: Mapping[str, float], count: int, seed: int) -> list[Problem]:
    """Both arms from random configurations to boxes of their own."""
    rng = np.random.default_rng(seed)
    out: list[Problem] = []
    what = f"problems {seed}: free configurations of both arms"
    for _ in until(lambda: len(out) >= count, what, _WAY_OUT, 100 * count):
        boxes = table_boxes(rng)
        scene = both.scene(home, boxes)
        ways: list[list[Array]] = []
        for arm, sign in zip(both.arms, (1.0, -1.0), strict=True):
            side = [box for box in boxes if sign * box.T[1, 3] > 0.0]
            alone = arm.scene(home, boxes).collides
            ways.append(around_box(arm, side[int(rng.integers(len(side)))], rng, alone) if side else [])
        goals = [np.concatenate([a, b]) for a in ways[0] for b in ways[1]]
        goals = [q for q in goals if not scene.collides(q)][:4]
        for _ in range(50 if goals else 0):
            start = np.concatenate([random_free(arm, rng, arm.scene(home, boxes).collides) for arm in both.arms])
            if not scene.collides(start):
                out.append(Problem("both", boxes, home, start, np.array(goals)))
                break
    return out


def random_free(arm: Arm, rng: np.random.Generator, collides: Collides) -> Array:
    """A random configuration that is free."""
    for _ in range(_TRIES):
        q = rng.uniform(arm.kinematics.lower, arm.kinematics.upper)
        if not collides(q):
            return q
    raise RuntimeError(f"{_TRIES} random configurations collide, all of them")


def _free(arm: Arm, pose: Array, rng: np.random.Generator, collides: Collides, want: int) -> list[Array]:
    solutions = arm.inverse.solutions(pose, arm.config.planning.joint_margin)
    order = rng.permutation(len(solutions))
    found: list[Array] = []
    for i in order[:12]:
        if not collides(solutions[i].q):
            found.append(solutions[i].q)
            if len(found) == want:
                break
    return found


def timed(planner: Planner, query: PlanQuery) -> tuple[Array | None, float]:
    """Plan: way points, None without a plan, and seconds of processor time: what it takes where one core is free."""
    begin = time.thread_time()
    try:
        path = planner.plan(query).waypoints
    except OpenArmError as error:
        if error.code != Code.NO_PLAN:
            raise
        return None, time.thread_time() - begin
    return path, time.thread_time() - begin
