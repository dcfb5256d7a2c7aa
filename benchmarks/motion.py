# SPDX-License-Identifier: Apache-2.0
"""Motion: inverse kinematics, collision checks, plans, and a pose sent over ROS until its timed trajectory is back.

    [OPENARM_ROBOT=NAME] python -m benchmarks.motion [--quick] [--only PREFIX] [--json PATH]

Problems are drawn from seeds that nothing was tuned on (`--tuning` takes those that were). On the table the arm knows
the boxes only from the map that the suite's mapper makes of rendered images; elsewhere obstacles are boxes. A path
counts when the exact layer agrees with every line of it, and a problem as feasible when a long run of another planner,
OMPL's RRTConnect with every check made by coal, or we solve it. Peers run in the same process on the same problems.
The time to make the scene that a plan searches in, from the cells of the map on, is a row of its own (p95), not part of
the plan's.
"""

from __future__ import annotations

import argparse
import itertools
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

from benchmarks.motion_ik import ik_rows
from benchmarks.motion_problems import (
    REPORTED,
    TUNING,
    Problem,
    dual_problems,
    random_free,
    shelf_problems,
    table_boxes,
    table_problems,
    timed,
)
from benchmarks.report import Row, write_report
from openarm_common.camera.cameras import load_cameras
from openarm_common.camera.housings import with_housings
from openarm_common.errors import OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_common.types import Array
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.occupancy import Environment
from openarm_motion.config import MotionConfig
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.planning.moves import RequestBoxes, to_pose
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlanQuery
from openarm_motion.planning.rrt import FastPlanner, warm_search
from openarm_motion.service.motion_service import table_box

#: A problem counts as feasible when some planner finds a path within this time, s.
_LONG = 20.0
_COAL = "OMPL RRTConnect, coal alone"
_CALLBACKS = "OMPL RRTConnect, our checks by Python callbacks"


def arms_and_home() -> tuple[dict[str, Arm], dict[str, float]]:
    """The arms of the process's robot with its table, and its joints at home."""
    description = with_housings(RobotDescription.load(), load_cameras().values())
    table = table_box(robot_work().table)
    arms = {name: Arm(name, description, MotionConfig(), [table]) for name in description.arm_names}
    home = dict[str, float]()
    for name in arms:
        home |= description.group_state(f"{name}_arm", "home") | {description.finger_joint(name): 0.0}
    return arms, home


def plan_rows(
    name: str,
    problems: Sequence[Problem],
    query_of: Callable[[Problem], PlanQuery],
    targets: tuple[float, float],
) -> list[Row]:
    """Median and p95 of a set of problems, and the share that was solved of those that some planner can solve."""
    ours, peer = FastPlanner(), OmplPlanner()
    times, packing, update, coal, callbacks, solved, feasible, odd = [], [], [], [], [], 0, 0, 0
    first = query_of(problems[0])
    if first.fast is not None:  # a node loads what was compiled at its start
        warm_search(first.fast(), first.start)
    for problem in problems:
        asked = time.perf_counter()
        query = query_of(problem)
        if query.fast is None:
            raise RuntimeError("the query has no fast layer")
        begin = time.perf_counter()
        fast = query.fast()  # a scene is made once and serves all plans in it
        packing.append(time.perf_counter() - begin)
        update.append(time.perf_counter() - asked)
        path, seconds = timed(ours, query)
        free = path is not None and all(query.edge_free(a, b) for a, b in itertools.pairwise(path))
        odd += path is not None and not free
        times.append(seconds)
        solved += free
        long, seconds = timed(peer, replace(query, time_limit=_LONG))
        coal.append(seconds)
        feasible += free or long is not None
        callbacks.append(timed(peer, _by_callbacks(query, fast))[1])
    n, goal = len(problems), 100.0 if name == "table" else 99.0
    median, p95 = _p(times, 50), _p(times, 95)
    return [
        Row(f"{name}_median_ms", median, "ms", "lower", targets[0], _COAL, _p(coal, 50), n),
        Row(f"{name}_p95_ms", p95, "ms", "lower", targets[1], _COAL, _p(coal, 95), n),
        Row(f"{name}_callbacks_median_ms", median, "ms", "lower", targets[0], _CALLBACKS, _p(callbacks, 50), n),
        Row(f"{name}_callbacks_p95_ms", p95, "ms", "lower", targets[1], _CALLBACKS, _p(callbacks, 95), n),
        Row(f"{name}_worst_ms", _p(times, 100), "ms", "lower", None, _COAL, _p(coal, 100), n),
        Row(f"{name}_fast_scene_ms", _p(packing, 50), "ms", "lower", 30.0, n=n),
        Row(f"{name}_scene_update_ms", _p(update, 95), "ms", "lower", 30.0, n=n),
        Row(f"{name}_not_free", odd, "", "lower", 0.0, n=n),
        Row(f"{name}_success", 100.0 * solved / max(feasible, 1), "%", "higher", goal, n=feasible),
    ]


def _by_callbacks(query: PlanQuery, fast: FastScene) -> PlanQuery:
    """The same checks, asked for from Python."""
    step, travel = query.resolution
    return replace(
        query,
        fast=None,
        collides=lambda q: not fast.free(q),
        edge_free=lambda a, b: fast.edge_free(a, b, step, travel),
    )


def check_rows(both: DualArm, home: Mapping[str, float], count: int) -> list[Row]:
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


def pose_rows(arms: Mapping[str, Arm], home: Mapping[str, float], count: int) -> list[Row]:
    """A pose of the tool to a validated trajectory from home, of poses in which nothing of the robot touches."""
    rng, times, planned = np.random.default_rng(4), list[float](), 0
    for k in range(count):
        arm = list(arms.values())[k % len(arms)]
        scene = arm.scene(home)
        pose = arm.kinematics.fk(random_free(arm, rng, lambda q, s=scene: any(c.distance <= 0 for c in s.contacts(q))))
        begin = time.process_time()
        try:
            to_pose(arm, arm.start_state(home), pose, RequestBoxes())
            planned += 1
        except OpenArmError as error:
            print(f"pose {k}: {error}")
        times.append(time.process_time() - begin)
    return [
        Row("pose_p50", _p(times, 50), "ms", "lower", 10.0, n=count),
        Row("pose_p95", _p(times, 95), "ms", "lower", 50.0, n=count),
        Row("pose_planned", 100.0 * planned / count, "%", "higher", 99.0, n=count),
    ]


def ros_rows(count: int) -> list[Row]:
    """A pose to the running node until its trajectory is back; the same node with another planner as the peer."""
    times, peer = _through_ros("fast", count)[0], _through_ros("ompl", count)[0]
    label = "the same node with OMPL RRTConnect and coal"
    return [
        Row("pose_to_trajectory_median_ms", _p(times, 50), "ms", "lower", 30.0, label, _p(peer, 50), len(times)),
        Row("pose_to_trajectory_p95_ms", _p(times, 95), "ms", "lower", 100.0, label, _p(peer, 95), len(times)),
    ]


def moveit_rows(count: int) -> list[Row]:
    """A pose to /move_action until its trajectory is back; the suite's own action of the same node as the peer."""
    peer, times = _through_ros("fast", count, moveit=True)
    label, more = "/motion/move, the same poses", 3.0
    return [
        Row(f"moveit_{name}_ms", _p(times, p), "ms", "lower", _p(peer, p) + more, label, _p(peer, p), len(times))
        for name, p in (("median", 50), ("p95", 95))
    ]


def _through_ros(planner: str, count: int, *, moveit: bool = False) -> tuple[list[float], list[float]]:
    from benchmarks.motion_ros import Client

    environment = {**os.environ, "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
    parameters = ["scene:=demo", f"planning.planner:={planner}"]
    command = [
        sys.executable,
        "-m",
        "openarm_motion.ros.node",
        "--ros-args",
        *(x for p in parameters for x in ("-p", p)),
    ]
    arms, home = arms_and_home()
    node = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        with Client(home) as client:
            return client.measure(list(arms.values()), count, moveit=moveit)
    finally:
        node.terminate()
        node.wait(10.0)


def main() -> None:
    """Run it all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer problems: within two minutes")
    parser.add_argument(
        "--only", default="", help="parts whose name begins so: pose, ik, check, table, shelf, dual, ros, moveit"
    )
    parser.add_argument("--tuning", action="store_true", help="the problems that steps of the search were chosen on")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    quick, seeds = args.quick, TUNING if args.tuning else REPORTED
    arms, home = arms_and_home()
    sides = list(arms.values())

    def single(name: str, problems: list[Problem], targets: tuple[float, float]) -> list[Row]:
        def query(problem: Problem) -> PlanQuery:
            arm = arms[problem.arm]
            seen = problem.known.map
            known = Environment(map=None if seen is None else replace(seen))  # nothing of it is worked out yet
            scene = arm.scene(problem.state, problem.boxes, environment=known)
            return arm.query(scene, StartState(problem.state, problem.start), problem.goals, 5.0)

        return plan_rows(name, problems, query, targets)

    def problems(name: str, most: int, few: int) -> tuple[int, int]:
        return (few if quick else most), seeds[name]

    parts: dict[str, Callable[[], list[Row]]] = {
        "pose": lambda: pose_rows(arms, home, 60 if quick else 300),
        "ik": lambda: ik_rows(arms, 1000 if quick else 20_000, 20 if quick else 150),
        "table": lambda: single("table", table_problems(sides, home, *problems("table", 200, 30)), (1.0, 5.0)),
        "shelf": lambda: single("shelf", shelf_problems(sides, home, *problems("shelf", 100, 10)), (10.0, 50.0)),
    }
    if len(sides) == 2:
        both = DualArm(*sides)

        def dual(problem: Problem) -> PlanQuery:
            scene = both.scene(problem.state, problem.boxes)
            return both.query(scene, StartState(problem.state, problem.start, 0.5), problem.goals, 5.0)

        parts |= {
            "check": lambda: check_rows(both, home, 500 if quick else 5000),
            "dual": lambda: plan_rows("dual", dual_problems(both, home, *problems("dual", 100, 10)), dual, (5.0, 50.0)),
        }
    parts |= {"ros": lambda: ros_rows(20 if quick else 200), "moveit": lambda: moveit_rows(20 if quick else 200)}
    rows = [row for name, part in parts.items() if name.startswith(args.only) for row in part()]
    write_report(rows, args.json)


def _each(work: Callable[[tuple[Array, Array]], object], items: Sequence[tuple[Array, Array]]) -> float:
    """Median time, ms."""
    times = []
    for item in items:
        begin = time.perf_counter()
        work(item)
        times.append(time.perf_counter() - begin)
    return _p(times, 50)


def _p(seconds: Sequence[float], percent: float) -> float:
    return float(np.percentile(seconds, percent)) * 1e3


if __name__ == "__main__":
    main()
