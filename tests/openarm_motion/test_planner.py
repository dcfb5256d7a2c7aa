# SPDX-License-Identifier: Apache-2.0
"""Free joint paths."""

from __future__ import annotations

import itertools
import time

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.exact import Clearance, CollisionContext, CollisionScene
from openarm_motion.collision.solids import Box
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlannedPath, PlanQuery
from tests.refusals import refused, refuses


def query(arm: Arm, scene: CollisionScene, start: np.ndarray, goals: np.ndarray, **kwargs: object) -> PlanQuery:
    return PlanQuery(
        start=start,
        goals=np.atleast_2d(goals),
        lower=arm.kinematics.lower,
        upper=arm.kinematics.upper,
        collides=scene.collides,
        edge_free=lambda a, b: scene.edge_free(a, b, 0.05, 0.02),
        **kwargs,
    )


def planar(start, goals, half: float, collides, edge_free, **limits: object) -> PlanQuery:
    """A query in a square of two joints."""
    ends = {"start": np.array(start), "goals": np.array(goals), "lower": np.full(2, -half), "upper": np.full(2, half)}
    return PlanQuery(**ends, collides=collides, edge_free=edge_free, **limits)


def assert_free(arm: Arm, state: dict[str, float], path: PlannedPath) -> None:
    """Nothing touches anywhere on the path, looked at more finely than the planner did; the table counts."""
    touch = Clearance(own=0.0, world=0.0, arms=0.0, hand=0.0, touch=0.0, rest=0.0)
    scene = CollisionScene(arm.robot, CollisionContext(state, arm.static, clearance=touch))
    for a, b in itertools.pairwise(path.waypoints):
        assert scene.edge_free(a, b, 0.01, 0.004)


def q_of(arm: Arm, state: dict[str, float]) -> np.ndarray:
    return np.array([state[name] for name in arm.names])


@pytest.mark.requirement("A-68")
def test_from_hanging_zero_to_home_and_back_around_table_and_chest(right: Arm, home: dict[str, float]) -> None:
    scene = right.scene(home)
    zero, there = np.zeros(7), q_of(right, home)
    assert not scene.edge_free(zero, there)
    for start, goal in ((zero, there), (there, zero)):
        path = OmplPlanner().plan(query(right, scene, start, goal))
        assert_free(right, home, path)
        np.testing.assert_array_equal(path.waypoints[[0, -1]], [start, goal])


@pytest.mark.long
def test_home_to_fifty_pre_grasps_is_quick(right: Arm, home: dict[str, float]) -> None:
    """By the time of this thread."""
    scene, start = right.scene(home), q_of(right, home)
    rng = np.random.default_rng(0)
    took: list[float] = []
    while len(took) < 50:
        yaw = rng.uniform(-np.pi, np.pi)
        R = se3.rotation_from_z_y((0, 0, -1), (np.cos(yaw), np.sin(yaw), 0))
        pose = se3.make(R, (rng.uniform(0.16, 0.36), -rng.uniform(0.06, 0.42), 0.53))
        goals = [s.q for s in right.inverse.solutions(pose, 0.05) if not scene.collides(s.q)]
        if not goals:
            continue
        begin = time.thread_time()
        path = OmplPlanner().plan(query(right, scene, start, np.array(goals)))
        took.append(time.thread_time() - begin)
        np.testing.assert_array_equal(path.waypoints[-1], goals[path.goal])
    assert np.median(took) < 0.3


def test_the_first_of_several_goals_is_preferred(right: Arm, home: dict[str, float]) -> None:
    scene, start = right.scene(home), q_of(right, home)
    far, near = start + 0.3, start + 0.05
    assert OmplPlanner().plan(query(right, scene, start, np.stack([far, near]))).goal == 0


def test_a_goal_that_can_be_reached_is_found_among_those_that_cannot(right: Arm, home: dict[str, float]) -> None:
    scene = right.scene(home)
    there = q_of(right, home)
    blocked = next(
        q
        for q in np.random.default_rng(1).uniform(right.kinematics.lower, right.kinematics.upper, (500, 7))
        if scene.collides(q)
    )
    path = OmplPlanner().plan(query(right, scene, np.zeros(7), np.stack([blocked, there])))
    assert path.goal == 1
    assert_free(right, home, path)


def test_same_seed_same_path(right: Arm, home: dict[str, float]) -> None:
    scene, goal = right.scene(home), q_of(right, home)
    paths = [OmplPlanner().plan(query(right, scene, np.zeros(7), goal, seed=s)).waypoints for s in (5, 6, 5)]
    np.testing.assert_array_equal(paths[0], paths[2])
    assert paths[0].shape != paths[1].shape or not np.allclose(paths[0], paths[1])


def test_a_start_outside_the_bounds_by_rounding_is_planned_from(right: Arm, home: dict[str, float]) -> None:
    scene = right.scene(home)
    start = np.zeros(7)
    start[3] = -6e-9  # joint 4 begins at 0
    path = OmplPlanner().plan(query(right, scene, start, q_of(right, home)))
    np.testing.assert_array_equal(path.waypoints[0], start)


def test_what_has_no_way_is_given_up_in_time() -> None:
    # a wall through all of the space
    def edge_free(a: np.ndarray, b: np.ndarray) -> bool:
        return a[0] * b[0] > 0.0

    goals = [[0.5, 0.0], [0.5, 0.5]]
    nothing = planar([-0.5, 0.0], goals, 1.0, lambda q: bool(abs(q[0]) < 0.1), edge_free, time_limit=0.3)
    assert refused(r"no free path to any of 2 goal.* within 0\.3 s", OmplPlanner().plan, nothing).code is Code.NO_PLAN


@pytest.mark.requirement("N-18")
def test_samples_limit_a_search_in_place_of_time() -> None:
    seen = 0

    def collides(q: np.ndarray) -> bool:
        nonlocal seen
        seen += 1
        return bool(abs(q[0]) < 0.1)

    def give_up(iterations: int) -> int:
        nonlocal seen
        seen = 0
        limits = {"time_limit": 1e-9, "iterations": iterations}
        nothing = planar([-0.5, 0.0], [[0.5, 0.0]], 1.0, collides, lambda a, b: a[0] * b[0] > 0.0, **limits)
        refused(f"within {iterations} samples", OmplPlanner().plan, nothing)
        return seen

    few = give_up(100)
    assert few > 10
    assert few == give_up(100)
    assert give_up(400) > 2 * few


def test_a_plan_can_be_stopped(right: Arm, home: dict[str, float]) -> None:
    scene = right.scene(home)
    asked = []

    def stopped() -> bool:
        asked.append(True)
        return len(asked) > 3

    with refuses(Code.CANCELLED):
        OmplPlanner().plan(query(right, scene, np.zeros(7), q_of(right, home), stopped=stopped))


def test_the_reason_for_no_plan_names_what_blocks_the_direct_way(right: Arm, home: dict[str, float]) -> None:
    start = q_of(right, home)
    goal = start + np.array([0.6, 0, 0, 0, 0, 0, 0])
    middle = right.kinematics.fk(0.5 * (start + goal))
    post = Box("post", middle, np.array([0.05, 0.05, 0.05]))

    class NeverPlanner:
        def plan(self, query: PlanQuery) -> PlannedPath:
            raise OpenArmError(Code.NO_PLAN, "none")

    arm = Arm("right", right.description, right.config, right.static, NeverPlanner())
    refused(r"on the direct way .* post", arm.plan, arm.scene(home, [post]), arm.start_state(home), goal[None], 0.1)


def test_what_the_search_finds_is_shortened() -> None:
    def around_a_disc(a: np.ndarray, b: np.ndarray) -> bool:
        u = np.linspace(0, 1, 200)[:, None]
        return bool(np.all(np.linalg.norm(a + u * (b - a) - [0.5, 0.0], axis=1) > 0.9))

    asked = planar([-1.0, 0.0], [[2.0, 0.0]], 6.0, lambda q: not around_a_disc(q, q), around_a_disc)
    path = OmplPlanner().plan(asked)
    assert all(around_a_disc(a, b) for a, b in itertools.pairwise(path.waypoints))
    assert float(np.linalg.norm(np.diff(path.waypoints, axis=0), axis=1).sum()) < 1.3 * 3.6
