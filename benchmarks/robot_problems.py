# SPDX-License-Identifier: Apache-2.0
"""Planning problems for arms on a stand in seven families of scenes, drawn from seeds. Base frame, m, rad.

The families, and the way to draw problems (a scene whose place and objects vary, start and goals by inverse kinematics
of poses at an object), are those of Chamzas et al., "MotionBenchMaker: a tool to generate and benchmark motion planning
datasets", RA-L 2022; scenes and poses are of our own making.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from zlib import crc32

import numpy as np

from benchmarks.robot_models import ROBOTS, TrueMeshes
from openarm_common import se3
from openarm_common.types import Array
from openarm_motion.collision.solids import Cylinder, Solid, box_from
from openarm_motion.kinematics.chain import ArmKinematics

_BOARD, _CAN, _TALL = 0.04, 0.03, 0.14
#: Goals of a problem at most, guesses of the inverse kinematics for each pose, scenes drawn before giving up.
_GOALS, _GUESSES, _SCENES = 4, 25, 60


@dataclass(frozen=True, eq=False)
class Scene:
    """Bodies, and poses (4, 4) of what a hand is to reach, z where the hand points; all in the frame of the scene.

    Attributes:
        bodies: Obstacles.
        goals: Any of these will do.
        start: Where the hand starts; None is the robot's home posture.
        spread: How far the scene may be shifted in x, y, z (m) and turned about the robot (rad).
    """

    bodies: tuple[Solid, ...]
    goals: tuple[Array, ...]
    spread: tuple[float, float, float, float]
    start: Array | None = None


@dataclass(frozen=True, eq=False)
class RobotProblem:
    """Obstacles, a start (n,) and goals (k, n)."""

    obstacles: tuple[Solid, ...]
    start: Array
    goals: Array


def _box(id: str, p: tuple[float, float, float], size: tuple[float, float, float], R: Array | None = None) -> Solid:
    return box_from(id, p, size, R)


def _can(id: str, x: float, y: float, z: float, radius: float = _CAN, length: float = _TALL) -> Solid:
    """A can that stands at a height."""
    return Cylinder(id, se3.make(None, (x, y, z + 0.5 * length + 0.002)), radius, length)


def _forward(x: float, y: float, z: float, rng: np.random.Generator) -> Array:
    """A hand that points along x."""
    return se3.make(se3.rot_y(0.5 * math.pi) @ se3.rot_z(rng.choice((0.0, 0.5, 1.0, 1.5)) * math.pi), (x, y, z))


def _down(x: float, y: float, z: float, rng: np.random.Generator) -> Array:
    """A hand that points down."""
    return se3.make(se3.rot_x(math.pi) @ se3.rot_z(rng.uniform(-math.pi, math.pi)), (x, y, z))


def _bookshelf(rng: np.random.Generator, rows: int, columns: int, front: float, low: float, cell: float) -> Scene:
    """Compartments that are open to the robot, a can or two in each; the goal is before one of the cans."""
    depth, width = 0.6, 1.0
    x, top = front + 0.5 * depth, low + rows * cell
    bodies = [_box(f"board{k}", (x, 0.0, low + k * cell), (depth, width, _BOARD)) for k in range(rows + 1)]
    edges = np.linspace(-0.5 * width, 0.5 * width, columns + 1)
    bodies += [
        _box(f"upright{k}", (x, float(y), 0.5 * (low + top)), (depth, _BOARD, top - low + _BOARD))
        for k, y in enumerate(edges)
    ]
    goals: list[Array] = []
    wanted = int(rng.integers(rows * columns))
    for k in range(rows * columns):
        row, column = divmod(k, columns)
        middle, floor = 0.5 * float(edges[column] + edges[column + 1]), low + row * cell + 0.5 * _BOARD
        half = 0.5 * width / columns - 0.1
        for n, deep in enumerate((0.15, 0.4)[: int(rng.integers(1, 3))]):
            y = middle + float(rng.uniform(-half, half)) * 0.8
            bodies.append(_can(f"can{k}_{n}", front + deep, y, floor))
            if k == wanted and n == 0:
                goals = [_forward(front + deep - 0.08, y, floor + 0.11, rng) for _ in range(4)]
    return Scene(tuple(bodies), tuple(goals), (0.08, 0.1, 0.08, 0.4))


def _walls(x: float, low: float, edge: float, front: float) -> list[Solid]:
    """A square box that is open at the top; the height of the front differs."""
    half, up = 0.5 * edge, low + 0.5 * edge
    return [
        _box("bottom", (x, 0.0, low), (edge, edge, _BOARD)),
        _box("left", (x, half, up), (edge, _BOARD, edge)),
        _box("right", (x, -half, up), (edge, _BOARD, edge)),
        _box("back", (x + half, 0.0, up), (_BOARD, edge, edge)),
        _box("front", (x - half, 0.0, low + 0.5 * front), (_BOARD, edge, front)),
    ]


def _open_box(rng: np.random.Generator) -> Scene:
    """A box under a slanted lid, with a can on its bottom."""
    x, low, edge = 0.62, -0.2, 0.6
    y = float(rng.uniform(-0.12, 0.12))
    lid = _box("lid", (x + 0.12, 0.0, low + 0.95), (edge, edge, _BOARD), se3.rot_y(0.7))
    bodies = [*_walls(x, low, edge, 0.8 * edge), lid, _can("can", x, y, low + 0.5 * _BOARD)]
    goals = [_down(x, y, low + 0.26, rng) for _ in range(4)]
    return Scene(tuple(bodies), tuple(goals), (0.06, 0.06, 0.06, 0.3))


def _cage(rng: np.random.Generator) -> Scene:
    """A box with a roof and bars across its front; the goal is inside, above a cube."""
    x, low, edge = 0.62, -0.1, 0.7
    y = float(rng.uniform(-0.1, 0.1))
    bodies = [
        *_walls(x, low, edge, 0.04)[:4],
        _box("bar0", (x - 0.5 * edge, 0.0, low + 0.16), (_BOARD, edge, _BOARD)),
        _box("bar1", (x - 0.5 * edge, 0.0, low + 0.46), (_BOARD, edge, _BOARD)),
        _box("roof", (x + 0.025, 0.0, low + 0.71), (edge - 0.05, edge - 0.05, _BOARD)),
        _box("cube", (x - 0.05, y, low + 0.06), (0.07, 0.07, 0.07)),
    ]
    goals = [_down(x - 0.05, y, low + 0.16 + float(rng.uniform(0.0, 0.06)), rng) for _ in range(6)]
    return Scene(tuple(bodies), tuple(goals), (0.05, 0.05, 0.05, 0.25))


def _table(rng: np.random.Generator, under: bool) -> Scene:
    """A table with things on it; the goal is before a can, the start is home or under the table."""
    x, z = 0.95, 0.15
    bodies = [_box("top", (x, 0.0, z), (1.1, 1.8, _BOARD))]
    bodies += [
        _box(f"leg{k}", (x + a, b, z - 0.37), (0.05, 0.05, 0.7))
        for k, (a, b) in enumerate((a, b) for a in (-0.5, 0.5) for b in (-0.8, 0.8))
    ]
    y, floor = float(rng.uniform(-0.15, 0.15)), z + 0.5 * _BOARD
    bodies.append(_can("can", 0.66, y, floor))
    bodies.append(_box("cube", (0.62, 0.42, floor + 0.127), (0.25, 0.25, 0.25)))
    for k, (a, b, size) in enumerate((
        (0.56, 0.22, (0.02, 0.16, 0.34)), (0.86, 0.2, (0.2, 0.05, 0.35)), (0.56, -0.27, (0.2, 0.05, 0.35)),
        (0.86, -0.2, (0.2, 0.02, 0.4)),
    )):  # fmt: skip
        p = np.array((a, b)) + rng.uniform(-0.03, 0.03, 2)
        turn = se3.rot_z(rng.uniform(-0.4, 0.4))
        bodies.append(_box(f"thing{k}", (float(p[0]), float(p[1]), floor + 0.5 * size[2] + 0.002), size, turn))
    goals = [_forward(0.58, y, floor + 0.09, rng) for _ in range(4)]
    start = _forward(0.5, float(rng.uniform(-0.1, 0.1)), z - 0.25, rng) if under else None
    return Scene(tuple(bodies), tuple(goals), (0.04, 0.05, 0.04, 0.2), start)


FAMILIES: Mapping[str, Callable[[np.random.Generator], Scene]] = {
    "bookshelf_small": lambda rng: _bookshelf(rng, 1, 1, 0.42, 0.25, 0.3),
    "bookshelf_tall": lambda rng: _bookshelf(rng, 3, 1, 0.42, -0.05, 0.3),
    "bookshelf_thin": lambda rng: _bookshelf(rng, 5, 2, 0.45, -0.35, 0.25),
    "box": _open_box,
    "cage": _cage,
    "table_pick": lambda rng: _table(rng, under=False),
    "table_under_pick": lambda rng: _table(rng, under=True),
}


def problems(
    robot: str, family: str, count: int, seed: int, chain: ArmKinematics, judge: TrueMeshes
) -> list[RobotProblem]:
    """Draw problems whose start and goals touch nothing by the triangles of the robot's meshes.

    Args:
        robot: Of `ROBOTS`.
        family: Of `FAMILIES`.
        count: How many.
        seed: The same problems for the same seed.
        chain: The arm.
        judge: What says whether a configuration is free.

    Raises:
        RuntimeError: when too few scenes can be reached.
    """
    rng = np.random.default_rng([seed, crc32(f"{robot} {family}".encode())])
    out: list[RobotProblem] = []
    for _ in range(_SCENES * count):
        found = _problem(robot, FAMILIES[family](rng), rng, chain, judge)
        if found is not None:
            out.append(found)
        if len(out) == count:
            return out
    raise RuntimeError(f"{robot}, {family}: {len(out)} problems in {_SCENES * count} scenes, expected {count}")


def _problem(
    robot: str, scene: Scene, rng: np.random.Generator, chain: ArmKinematics, judge: TrueMeshes
) -> RobotProblem | None:
    """A problem in a scene that is shifted and turned; None when start or goal can't be reached."""
    *shift, turn = rng.uniform(-1.0, 1.0, 4) * scene.spread
    shift[2] += judge.stand
    T = se3.make(se3.rot_z(turn), (0.0, 0.0, 0.0)) @ se3.make(None, shift)
    bodies = tuple(_moved(body, T) for body in scene.bodies)
    hits = judge.around(bodies)
    start = np.array(ROBOTS[robot].home)
    if scene.start is not None:
        starts = _reached(robot, T @ scene.start, rng, chain, hits)
        if not starts:
            return None
        start = starts[0]
    elif hits(start):
        return None
    goals = [q for goal in scene.goals for q in _reached(robot, T @ goal, rng, chain, hits)][:_GOALS]
    return RobotProblem(bodies, start, np.array(goals)) if goals else None


def _moved(body: Solid, T: Array) -> Solid:
    if isinstance(body, Cylinder):
        return Cylinder(body.id, T @ body.T, body.radius, body.length)
    return box_from(body.id, (T @ body.T)[:3, 3], body.extents, (T @ body.T)[:3, :3])


def _reached(
    robot: str, goal: Array, rng: np.random.Generator, chain: ArmKinematics, hits: Callable[[Array], bool]
) -> list[Array]:
    """At most one free configuration (n,) with the hand at a pose."""
    tool = goal @ se3.make(None, (0.0, 0.0, -ROBOTS[robot].reach))
    for _ in range(_GUESSES):
        found = chain.ik(tool, rng.uniform(chain.lower, chain.upper), tolerance=(1e-4, 1e-3), restarts=0)
        if found.success and not hits(found.q):
            return [found.q]
    return []
