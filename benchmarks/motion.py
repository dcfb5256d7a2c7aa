# SPDX-License-Identifier: Apache-2.0
"""Motion: inverse kinematics, collision checks, plans, and a pose sent over ROS until its timed trajectory is back.

    python benchmarks/motion.py [--quick] [--only PREFIX] [--json PATH]

Problems are drawn from seeds; obstacles are boxes. Peers run in the same process on the same problems: pinocchio's
kinematics with damped least squares written in Python, and OMPL's RRTConnect with every check made by coal, called
from Python. The time to make the scene that a plan searches in is a row of its own, not part of the plan's.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks.motion_problems import Problem, around_box, random_free, shelf_problems, table_boxes, table_problems
from benchmarks.report import Row, write_report
from openarm_common.cameras import load_cameras
from openarm_common.description import RobotDescription
from openarm_common.errors import Code, OpenArmError
from openarm_common.housings import with_housings
from openarm_motion.arm import Arm, Situation
from openarm_motion.both import BothArms
from openarm_motion.collision import box_from
from openarm_motion.config import MotionConfig
from openarm_motion.fast import FastScene
from openarm_motion.fast_planner import FastPlanner
from openarm_motion.planner import OmplPlanner, Planner, PlanQuery

Array = NDArray[np.float64]
_TOLERANCE = (1e-4, 1e-3)
#: A problem counts as feasible when some planner finds a path within this time, s.
_LONG = 20.0
_COAL = "OMPL RRTConnect, coal alone, Python callbacks"


def arms_and_home() -> tuple[dict[str, Arm], dict[str, float]]:
    """Both arms with the default table, and the robot's joints at home."""
    description = with_housings(RobotDescription.load(), load_cameras().values())
    table = box_from("table", (0.46, 0.0, 0.38), (0.7, 1.2, 0.04))
    arms = {side: Arm(side, description, MotionConfig(), [table]) for side in ("left", "right")}
    home = {**description.group_state("left_arm", "home"), **description.group_state("right_arm", "home")}
    return arms, {**home, description.finger_joint("left"): 0.0, description.finger_joint("right"): 0.0}


def ik_rows(arms: Mapping[str, Arm], count: int, peer_count: int) -> list[Row]:
    """Reachable poses: tool poses of random configurations within the limits."""
    times: list[float] = []
    peer_times: list[float] = []
    solved = peer_solved = 0
    for arm in arms.values():
        chain = arm.kinematics
        targets = chain.fk_many(np.random.default_rng(6).uniform(chain.lower, chain.upper, (count, chain.n)))
        chain.ik(targets[0], tolerance=_TOLERANCE)
        for target in targets:
            begin = time.perf_counter()
            result = chain.ik(target, tolerance=_TOLERANCE)
            times.append(time.perf_counter() - begin)
            solved += _reached(chain.fk(result.q), target) and chain.margin(result.q) >= -1e-9
        peer = PinocchioIk(arm)
        for target in targets[:peer_count]:
            begin = time.perf_counter()
            q = peer.solve(target)
            peer_times.append(time.perf_counter() - begin)
            peer_solved += _reached(chain.fk(q), target)
    n, peer_n, name = len(times), len(peer_times), "pinocchio in Python, 20 restarts"
    return [
        Row("ik_success", 100.0 * solved / n, "%", "higher", 99.9, name, 100.0 * peer_solved / peer_n, n),
        Row("ik_p95_ms", _p(times, 95), "ms", "lower", 0.2, name, _p(peer_times, 95), n),
    ]


class PinocchioIk:
    """Damped least squares with pinocchio's kinematics, the loop in Python."""

    def __init__(self, arm: Arm) -> None:
        full = pin.buildModelFromXML(arm.description.urdf)
        others = [i for i, name in enumerate(full.names) if i > 0 and name not in arm.names]
        self._model = pin.buildReducedModel(full, others, pin.neutral(full))
        self._data = self._model.createData()
        self._frame = self._model.getFrameId(arm.kinematics.tool_link)
        self._rng = np.random.default_rng(0)

    def solve(self, target: Array, restarts: int = 20, iterations: int = 100) -> Array:
        """The best configuration found."""
        model, data = self._model, self._data
        lower, upper = model.lowerPositionLimit, model.upperPositionLimit
        goal, q = pin.SE3(target), 0.5 * (lower + upper)
        for _ in range(restarts + 1):
            for _ in range(iterations):
                pin.computeJointJacobians(model, data, q)
                here = pin.updateFramePlacement(model, data, self._frame)
                error = pin.log6(here.actInv(goal)).vector
                if _reached(here.homogeneous, target):
                    return q
                J = pin.getFrameJacobian(model, data, self._frame, pin.LOCAL)
                step = J.T @ np.linalg.solve(J @ J.T + (0.5 * error @ error + 1e-6) * np.eye(6), error)
                q = np.clip(q + np.clip(step, -0.6, 0.6), lower, upper)
            q = self._rng.uniform(lower, upper)
        return q


def plan_rows(
    name: str,
    problems: Sequence[Problem],
    query_of: Callable[[Problem], PlanQuery],
    planners: tuple[Planner, Planner],
    targets: tuple[float, float],
    peer_count: int,
) -> list[Row]:
    """Median and p95 of a set of problems, and the share that was solved of those that some planner can solve."""
    ours, peer = planners
    times, packing, peer_times, solved, feasible = [], [], [], 0, 0
    for k, problem in enumerate(problems):
        query = query_of(problem)
        begin = time.perf_counter()
        if query.fast is not None:
            query.fast()  # a scene is made once and serves all plans in it
        packing.append(time.perf_counter() - begin)
        done, seconds = _timed(ours, query)
        times.append(seconds)
        solved += done
        feasible += done or _timed(peer, replace(query, time_limit=_LONG))[0]
        if k < peer_count:
            peer_times.append(_timed(peer, query)[1])
    n = len(problems)
    rows = [
        Row(f"{name}_median_ms", _p(times, 50), "ms", "lower", targets[0], _COAL, _p(peer_times, 50), n),
        Row(f"{name}_p95_ms", _p(times, 95), "ms", "lower", targets[1], _COAL, _p(peer_times, 95), n),
    ]
    share = 100.0 * solved / max(feasible, 1)
    rows.append(Row(f"{name}_fast_scene_ms", _p(packing, 50), "ms", "lower", 30.0, n=n))
    return [*rows, Row(f"{name}_success", share, "%", "higher", 99.0 if name != "table" else 100.0, n=feasible)]


def dual_problems(both: BothArms, home: Mapping[str, float], count: int, seed: int = 2) -> list[Problem]:
    """Both arms from random configurations to boxes of their own."""
    rng = np.random.default_rng(seed)
    out: list[Problem] = []
    while len(out) < count:
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
                out.append(Problem(boxes, home, start, np.array(goals)))
                break
    return out


def check_rows(both: BothArms, home: Mapping[str, float], count: int) -> list[Row]:
    """Time of one state of both arms and of an edge of one arm, among table and boxes."""
    rng = np.random.default_rng(3)
    boxes = table_boxes(rng)
    scene = both.scene(home, boxes)
    states = rng.uniform(both.lower, both.upper, (count, both.lower.size))
    begin = time.perf_counter()
    for q in states:
        scene.collides(q)
    exact = (time.perf_counter() - begin) / count * 1e6
    fast = FastScene([scene.first, scene.second])
    fast.free_many(states[:1])
    batched = _each(lambda _: fast.free_many(states), [(states, states)] * 5) / count * 1e3
    arm = both.arms[0]
    alone = arm.scene(home, boxes)
    starts = [random_free(arm, rng, alone.collides) for _ in range(20)]
    edges = [(a, a + 1.4 * d / np.linalg.norm(d)) for a in starts for d in rng.normal(size=(2, a.size))]
    exact_ms = _each(lambda ab: alone.edge_free(ab[0], ab[1], 0.05, 0.02), edges)
    one = FastScene([alone])
    one.edge_free(*edges[0], 0.05, 0.02)
    fast_ms = _each(lambda ab: one.edge_free(ab[0], ab[1], 0.05, 0.02), edges)
    return [
        Row("state_check_us", batched, "us", "lower", 4.0, "coal, one state a call", exact, count),
        Row("edge_check_ms", fast_ms, "ms", "lower", 0.15, "coal, a state a call", exact_ms, len(edges)),
    ]


def ros_rows(count: int) -> list[Row]:
    """A pose to the running node until its trajectory is back."""
    from benchmarks.motion_ros import Client

    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    command = [sys.executable, "-m", "openarm_motion.node", "--ros-args", "-p", "scene:=demo"]
    arms, home = arms_and_home()
    node = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with Client(home) as client:
            times = client.measure(list(arms.values()), count)
    finally:
        node.terminate()
        node.wait(10.0)
    return [
        Row("pose_to_trajectory_median_ms", _p(times, 50), "ms", "lower", 30.0, n=len(times)),
        Row("pose_to_trajectory_p95_ms", _p(times, 95), "ms", "lower", 100.0, n=len(times)),
    ]


def main() -> None:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer problems: within two minutes")
    parser.add_argument("--only", default="", help="parts whose name begins so: ik, check, table, shelf, dual, ros")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    quick = args.quick
    arms, home = arms_and_home()
    both = BothArms(arms["left"], arms["right"])
    ours, peer = FastPlanner(), OmplPlanner()

    def one(problem: Problem, index: int) -> PlanQuery:
        arm = list(arms.values())[index % 2]
        scene = arm.scene(problem.state, problem.boxes)
        return arm.query(scene, Situation(problem.state, problem.start), problem.goals, 5.0)

    def single(name: str, problems: list[Problem], targets: tuple[float, float], peers: int) -> list[Row]:
        index = {id(problem): k for k, problem in enumerate(problems)}
        return plan_rows(name, problems, lambda p: one(p, index[id(p)]), (ours, peer), targets, peers)

    def dual(problem: Problem) -> PlanQuery:
        scene = both.scene(problem.state, problem.boxes)
        return both.query(scene, problem.start, problem.goals, 0.5, 5.0)

    sides = list(arms.values())
    parts: dict[str, Callable[[], list[Row]]] = {
        "ik": lambda: ik_rows(arms, 1000 if quick else 10_000, 20 if quick else 150),
        "check": lambda: check_rows(both, home, 500 if quick else 5000),
        "table": lambda: single(
            "table", table_problems(sides, home, 30 if quick else 200), (1.0, 5.0), 10 if quick else 50
        ),
        "shelf": lambda: single(
            "shelf", shelf_problems(sides, home, 10 if quick else 100), (10.0, 50.0), 4 if quick else 20
        ),
        "dual": lambda: plan_rows(
            "dual",
            dual_problems(both, home, 10 if quick else 100),
            dual,
            (ours, peer),
            (5.0, 50.0),
            4 if quick else 20,
        ),
        "ros": lambda: ros_rows(20 if quick else 200),
    }
    rows = [row for name, part in parts.items() if name.startswith(args.only) for row in part()]
    write_report(rows, args.json)


def _timed(planner: Planner, query: PlanQuery) -> tuple[bool, float]:
    begin = time.perf_counter()
    try:
        planner.plan(query)
    except OpenArmError as error:
        if error.code != Code.NO_PLAN:
            raise
        return False, time.perf_counter() - begin
    return True, time.perf_counter() - begin


def _each(work: Callable[[tuple[Array, Array]], object], items: Sequence[tuple[Array, Array]]) -> float:
    """Median time, ms."""
    times = []
    for item in items:
        begin = time.perf_counter()
        work(item)
        times.append(time.perf_counter() - begin)
    return _p(times, 50)


def _reached(pose: Array, target: Array) -> bool:
    away = pin.log3(pose[:3, :3].T @ target[:3, :3])
    near = float(np.linalg.norm(pose[:3, 3] - target[:3, 3])) <= _TOLERANCE[0]
    return near and float(np.linalg.norm(away)) <= _TOLERANCE[1]


def _p(seconds: Sequence[float], percent: float) -> float:
    return float(np.percentile(seconds, percent)) * 1e3


if __name__ == "__main__":
    main()
