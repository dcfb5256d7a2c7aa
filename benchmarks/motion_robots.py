# SPDX-License-Identifier: Apache-2.0
"""A Panda and a UR5e by their meshes, among shelves, boxes, cages and tables: seven families, 50 problems each.

    python benchmarks/motion_robots.py [--quick] [--only PREFIX] [--json PATH] [--tuning] [--peer-limit S]

Problems are drawn from seeds that nothing was tuned on (`--tuning` takes those that were); see `robot_problems`. The
peer is OMPL's RRTConnect on the same problems in the same run, with every check made by coal on the same convex hulls,
along lines at the default steps, which are four times ours.
A problem counts as feasible when we solve it, or the peer does, or, where both fail, OMPL with coal on the triangles of
the meshes does within a minute (`--long`). Times are processor time of the planning thread. Every path of both is
checked on the triangles, in states so near to each other that no joint turns by more than 0.01 rad between them, by
code that shares nothing with the collision layers: a state that touches is a hit. `accepted` is the share of random
states, 2 to 12 mm from a contact on the triangles, that the fast layer calls free.

`panda_turns` are plans to joint positions with a joint 7 that turns without end, start and goal anywhere in two turns,
past two posts. The peer is the same arm with limits far away, to the same postures in the nearest turns, which are
found here: what obstacles ask of joint 7 is the same for both.
"""

from __future__ import annotations

import argparse
import math
import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from benchmarks.motion_problems import timed
from benchmarks.report import Row, write_report
from benchmarks.robot_models import ROBOTS, TrueMeshes, load_arm, states_of
from benchmarks.robot_problems import FAMILIES, RobotProblem, problems
from openarm_common.errors import OpenArmError
from openarm_common.types import Array
from openarm_motion.collision.solids import box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.moves import RequestBoxes, to_joints
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlanQuery
from openarm_motion.planning.rrt import FastPlanner

#: Seeds of problems that steps of the search were chosen on, and of those that figures are reported of.
_TUNING, _REPORTED = 1, 64_000
#: Time that our planner has, s.
_LIMIT = 5.0
#: Distances on the triangles between which acceptance is asked for, m; states that are tried a problem, and problems.
_NEAR, _STATES, _SCENES = (0.002, 0.012), 400, 5
#: Targets over all families, ms.
_MEDIAN, _P95 = 2.0, 20.0
_PEER = "OMPL RRTConnect, coal on the same hulls"
#: Plans of a joint that turns without end, their peer, and where the limits of the peer are, rad.
_TURNS, _UNWOUND, _FAR = 200, "limits far away, nearest turns by hand", 30.0


@dataclass
class Tally:
    """What came of the problems of a robot in a family; times in s."""

    robot: str
    family: str
    ours: list[float]
    peer: list[float]
    solved: int = 0
    peer_solved: int = 0
    feasible: int = 0
    hits: int = 0
    peer_hits: int = 0
    near: int = 0
    accepted: int = 0

    def line(self) -> str:
        """A row of the table."""
        n, (m, p), (pm, pp) = len(self.ours), _percentiles(self.ours), _percentiles(self.peer)
        return (
            f"{self.robot:6s} {self.family:17s} {self.solved:4d} {self.peer_solved:5d} {self.feasible:4d}/{n:<4d}"
            f" {m:8.2f} {p:8.2f} {pm:9.1f} {pp:9.1f} {pm / m:7.1f} {self.hits:5d} {self.peer_hits:6d}"
            f" {self.accepted:5d}/{self.near}"
        )

    def rows(self) -> list[Row]:
        """The same for a report."""
        n, (m, p), (pm, pp) = len(self.ours), _percentiles(self.ours), _percentiles(self.peer)
        name, whole = f"{self.robot}_{self.family}", self.family == "all"
        share, peer = (100.0 * k / max(self.feasible, 1) for k in (self.solved, self.peer_solved))
        return [
            Row(f"{name}_median_ms", m, "ms", "lower", _MEDIAN if whole else None, _PEER, pm, n),
            Row(f"{name}_p95_ms", p, "ms", "lower", _P95 if whole else None, _PEER, pp, n),
            Row(f"{name}_success", share, "%", "higher", 100.0, _PEER, peer, self.feasible),
            Row(f"{name}_hits", self.hits, "", "lower", 0.0, _PEER, self.peer_hits, n),
            Row(f"{name}_accepted", 100.0 * self.accepted / max(self.near, 1), "%", "higher", 99.0, n=self.near),
        ]


def family_tally(
    robot: str, family: str, arm: Arm, judge: TrueMeshes, drawn: Sequence[RobotProblem], limits: tuple[float, float]
) -> Tally:
    """Let both planners solve the problems of a family.

    Args:
        robot: Its name.
        family: Its name.
        arm: The robot.
        judge: What knows its triangles.
        drawn: The problems.
        limits: Time of the peer, and of the run that decides whether a problem is feasible that both failed, s.
    """
    tally, rng = Tally(robot, family, [], []), np.random.default_rng(len(drawn))
    for number, problem in enumerate(drawn):
        scene = arm.scene({}, problem.obstacles)  # pyright: ignore[reportArgumentType]
        query = arm.query(scene, StartState({}, problem.start), problem.goals, _LIMIT)
        if query.fast is None:
            raise RuntimeError("the query has no fast layer")
        fast = query.fast()  # a scene is made once and serves all plans in it
        if number < _SCENES:
            touches, near = (judge.around(problem.obstacles, margin) for margin in _NEAR)
            states = rng.uniform(arm.lower, arm.upper, (_STATES, arm.lower.size))
            rows = np.array([near(q) and not touches(q) for q in states])
            tally.near += int(rows.sum())
            tally.accepted += int((rows & fast.free_many(states)).sum())
        hits = judge.around(problem.obstacles)
        path, seconds = timed(FastPlanner(), query)
        other, peer_seconds = timed(
            OmplPlanner(), replace(query, edge_free=scene.edge_free, fast=None, time_limit=limits[0])
        )
        tally.ours.append(seconds)
        tally.peer.append(peer_seconds)
        touched, peer_touched = (_touches(way, hits) for way in (path, other))
        tally.hits += touched
        tally.peer_hits += peer_touched
        tally.solved += path is not None and not touched
        tally.peer_solved += other is not None and not peer_touched
        solvable = path is not None or other is not None
        tally.feasible += solvable or timed(OmplPlanner(), _on_triangles(query, hits, limits[1]))[0] is not None
    return tally


def _touches(path: Array | None, hits: Callable[[Array], bool]) -> bool:
    return path is not None and any(hits(q) for q in states_of(path, 0.01))


def _on_triangles(query: PlanQuery, hits: Callable[[Array], bool], seconds: float) -> PlanQuery:
    """The same problem, with checks on the triangles in place of ours and more time."""
    goals = np.array([q for q in query.goals if not hits(q)])

    def edge_free(a: Array, b: Array) -> bool:
        return not any(hits(q) for q in states_of(np.stack([a, b]), 0.05))

    return replace(query, fast=None, goals=goals, collides=hits, edge_free=edge_free, time_limit=seconds)


def turn_rows(count: int) -> list[Row]:
    """Plan with a Panda that turns joint 7 without end."""
    arm, peer = load_arm("panda", endless="panda_joint7"), load_arm("panda", endless="panda_joint7")
    peer.lower = peer.kinematics.lower = np.append(arm.lower[:-1], -_FAR)
    peer.upper = peer.kinematics.upper = np.append(arm.upper[:-1], _FAR)
    posts = [box_from(f"post{side}", (0.45, side * 0.35, 0.9), (0.08, 0.08, 0.9)) for side in (-1, 1)]
    scene, rng = arm.scene({}, posts), np.random.default_rng(_REPORTED)
    low, high = (np.append(ends[:-1], turn) for ends, turn in zip(arm.kinematics.span, (-6.0, 6.0), strict=True))
    refused, beyond, seconds = np.zeros(2, np.int64), np.zeros((count, 2)), np.full((count, 2), np.nan)
    for k in range(count):
        start, goal = rng.uniform(low, high, (2, 7))
        while scene.collides(start) or scene.collides(goal):
            start, goal = rng.uniform(low, high, (2, 7))
        short = np.append(goal[:-1], start[-1] + math.remainder(goal[-1] - start[-1], math.tau))
        for i, (one, there) in enumerate(((arm, goal), (peer, short))):
            begin = time.thread_time()
            try:
                q = to_joints(one, StartState({}, start), there, RequestBoxes(posts)).q
            except OpenArmError:
                refused[i] += 1
                continue
            seconds[k, i] = time.thread_time() - begin
            beyond[k, i] = np.abs(np.diff(q[:, -1])).sum() - abs(short[-1] - start[-1])
    median, mean = np.nanmedian(seconds, axis=0) * 1e3, beyond.mean(axis=0)
    print(f"panda  turns of joint 7: {count - refused[0]} of {count} planned ({count - refused[1]} by the peer),")
    print(f"       {mean[0]:.3f} rad beyond the short way ({mean[1]:.3f}), {median[0]:.2f} ms ({median[1]:.2f})")
    return [
        Row("panda_turns_refused", float(refused[0]), "", "lower", 0.0, _UNWOUND, float(refused[1]), count),
        Row("panda_turns_beyond_rad", float(mean[0]), "rad", "lower", None, _UNWOUND, float(mean[1]), count),
        Row("panda_turns_median_ms", float(median[0]), "ms", "lower", None, _UNWOUND, float(median[1]), count),
    ]


def _percentiles(seconds: Sequence[float]) -> tuple[float, float]:
    """Median and p95, ms."""
    median, p95 = np.percentile(seconds, (50, 95))
    return float(median) * 1e3, float(p95) * 1e3


def _together(robot: str, tallies: Sequence[Tally]) -> Tally:
    """All families of a robot."""
    both = Tally(robot, "all", [s for t in tallies for s in t.ours], [s for t in tallies for s in t.peer])
    for name in ("solved", "peer_solved", "feasible", "hits", "peer_hits", "near", "accepted"):
        setattr(both, name, sum(getattr(t, name) for t in tallies))
    return both


def main() -> None:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="5 problems a family instead of 50")
    parser.add_argument("--only", default="", help=f"ROBOT or ROBOT_FAMILY that begins so: {', '.join(FAMILIES)}")
    parser.add_argument("--tuning", action="store_true", help="the problems that steps of the search were chosen on")
    parser.add_argument("--count", type=int, default=0, help="problems a family, in place of 50")
    parser.add_argument("--peer-limit", type=float, default=5.0, help="time that the peer has for a problem, s")
    parser.add_argument("--long", type=float, default=60.0, help="time to decide what is feasible, s")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    count, seed = args.count or (5 if args.quick else 50), _TUNING if args.tuning else _REPORTED
    limits = args.peer_limit, args.long
    print(
        "robot  family            ours  OMPL feasible   median      p95 OMPL med. OMPL p95   ratio  hits OMPL's"
        "  accepted   (ms)"
    )
    rows: list[Row] = []
    for robot in ROBOTS:
        families = [family for family in FAMILIES if f"{robot}_{family}".startswith(args.only)]
        if not families:
            continue
        arm = load_arm(robot, touching=True)
        judge = TrueMeshes(robot)
        # one problem first, so that everything is compiled
        family_tally(robot, "", arm, judge, problems(robot, families[0], 1, 0, arm.kinematics, judge), limits)
        tallies: list[Tally] = []
        for family in families:
            drawn = problems(robot, family, count, seed, arm.kinematics, judge)
            tallies.append(family_tally(robot, family, arm, judge, drawn, limits))
            print(tallies[-1].line(), flush=True)
        tallies.append(_together(robot, tallies))
        print(tallies[-1].line(), flush=True)
        rows += [row for tally in tallies for row in tally.rows()]
    if "panda_turns".startswith(args.only):
        rows += turn_rows(_TURNS // 10 if args.quick else _TURNS)
    write_report(rows, args.json)


if __name__ == "__main__":
    main()
