# SPDX-License-Identifier: Apache-2.0
"""Paths found on the fast layer, judged by the exact one."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.clearance_kernels import workspace
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.planning.arm import Arm, StartState, segment_time
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlanQuery
from openarm_motion.planning.rrt import FastPlanner
from openarm_motion.planning.search_kernels import grow
from tests.openarm_motion.conftest import ruckig_duration
from tests.refusals import refused


def ask(arm: Arm, home: dict[str, float], start: np.ndarray, goals: np.ndarray, boxes: Sequence[Box] = ()) -> PlanQuery:
    return arm.query(arm.scene(home, boxes), StartState(home, start), np.atleast_2d(goals), 5.0)


#: Posts and boards in the way of both arms.
CLUTTER = [
    *(box_from(f"post{i}", (0.36, y, 0.65), (0.03, 0.03, 0.5)) for i, y in enumerate((-0.42, -0.2, 0.2, 0.42))),
    box_from("board", (0.40, 0.0, 0.85), (0.25, 1.0, 0.03)),
]


def free_states(arm: Arm, home: dict[str, float], count: int, seed: int, boxes: Sequence[Box] = ()) -> np.ndarray:
    rng = np.random.default_rng(seed)
    scene = arm.scene(home, boxes)
    states = rng.uniform(arm.kinematics.lower, arm.kinematics.upper, (20 * count, arm.kinematics.n))
    return np.array([q for q in states if not scene.collides(q)][:count])


@pytest.mark.long
@pytest.mark.requirement("A-68")
def test_paths_between_any_states_are_free_for_the_exact_layer(arms: dict[str, Arm], home: dict[str, float]) -> None:
    arm = arms["left"]
    states = free_states(arm, home, 40, 3, CLUTTER)
    scene, searched = arm.scene(home, CLUTTER), 0
    for start, goal in itertools.pairwise(states):
        path = FastPlanner().plan(ask(arm, home, start, goal, CLUTTER))
        np.testing.assert_array_equal(path.waypoints[[0, -1]], [start, goal])
        searched += len(path.waypoints) > 2
        for a, b in itertools.pairwise(path.waypoints):
            assert scene.edge_free(a, b, 0.05, 0.02)
    assert searched > 5


def test_every_edge_of_both_trees_is_free(right: Arm, home: dict[str, float]) -> None:
    """Long ones, so that a free end says little."""
    start, goal = free_states(right, home, 2, 3, CLUTTER)
    scene = FastScene([right.scene(home, CLUTTER)])
    bounds, resolution = np.stack([right.kinematics.lower, right.kinematics.upper]), np.array((0.05, 0.02))
    edges: list[tuple[np.ndarray, np.ndarray]] = []
    for seed in range(20):
        trees, parents = np.empty((2, 500, start.size)), np.full((2, 500), -1, np.int64)
        trees[:, 0], counts = (start, goal), np.array([1, 1], np.int64)
        work = workspace(scene.model)
        grow(trees, parents, counts, bounds, 2.0, resolution, scene.levers, scene.model, work, 20, seed)
        for tree, up, count in zip(trees, parents, counts, strict=True):
            edges += [(tree[up[k]], tree[k]) for k in range(1, count)]
    assert len(edges) > 20
    assert all(scene.edge_free(a, b) for a, b in edges)


def test_the_same_query_gives_the_same_path(right: Arm, home: dict[str, float]) -> None:
    states = free_states(right, home, 4, 4, CLUTTER)
    for start, goal in itertools.pairwise(states):
        one, two = (FastPlanner().plan(ask(right, home, start, goal, CLUTTER)).waypoints for _ in range(2))
        np.testing.assert_array_equal(one, two)


@pytest.mark.requirement("P-20")
def test_as_many_solved_as_by_ompl(right: Arm, home: dict[str, float]) -> None:
    states = free_states(right, home, 10, 5, CLUTTER)
    fast = ompl = 0.0
    limits = right.limits(0.5)
    for start, goal in itertools.pairwise(states):
        query = ask(right, home, start, goal, CLUTTER)
        paths = [planner.plan(query).waypoints for planner in (FastPlanner(), OmplPlanner())]
        times = [sum(segment_time(a, b, limits) for a, b in itertools.pairwise(path)) for path in paths]
        fast, ompl = fast + times[0], ompl + times[1]
    assert fast < 1.3 * ompl  # no detours for the speed of the search


def test_any_of_several_goals_will_do_and_colliding_ones_are_left_out(right: Arm, home: dict[str, float]) -> None:
    states = free_states(right, home, 3, 6)
    inside = right.inverse.solutions(se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.3, -0.2, 0.39)), 0.0)
    assert right.scene(home).collides(inside[0].q)  # in the table
    goals = np.array([inside[0].q, states[1], states[2]])
    path = FastPlanner().plan(ask(right, home, states[0], goals))
    assert path.goal in (1, 2)
    np.testing.assert_array_equal(path.waypoints[-1], goals[path.goal])


def test_a_goal_in_a_closed_box_is_no_plan_and_a_stop_is_heard(right: Arm, home: dict[str, float]) -> None:
    start = np.array([home[name] for name in right.names])
    goal = free_states(right, home, 1, 7)[0]
    hand = right.kinematics.fk(goal)[:3, 3]
    blocked = ask(right, home, start, goal, [box_from("block", hand, (0.1, 0.1, 0.1))])
    assert refused(None, FastPlanner().plan, replace(blocked, time_limit=0.3)).code is Code.NO_PLAN
    assert refused(None, FastPlanner().plan, replace(blocked, stopped=lambda: True)).code is Code.CANCELLED


@pytest.mark.requirement("N-12")
def test_both_arms_keep_apart_on_the_whole_path(arms: dict[str, Arm], home: dict[str, float]) -> None:
    both = DualArm(arms["left"], arms["right"])
    rng = np.random.default_rng(12)
    scene, judge = both.scene(home), both.scene(home, separation=0.020)
    states = [q for q in rng.uniform(both.lower, both.upper, (600, 14)) if not scene.collides(q)][:10]
    for start, goal in itertools.pairwise(states):
        path = FastPlanner().plan(both.query(scene, StartState({}, start, 0.5), goal[None], 10.0))
        for a, b in itertools.pairwise(path.waypoints):
            assert judge.edge_free(a, b, 0.02, 0.01)


def test_durations_in_closed_form_are_those_of_ruckig(right: Arm) -> None:
    rng = np.random.default_rng(8)
    for scale in (0.1, 0.5, 1.0):
        limits = right.limits(scale)
        stacked = np.stack([limits.velocity, limits.acceleration, limits.jerk])
        for size in (1e-3, 0.03, 0.3, 3.0):
            a, b = rng.normal(size=(2, 7)) * size
            most = np.min(stacked / np.abs(b - a), axis=1)
            assert segment_time(a, b, limits) == pytest.approx(ruckig_duration(1.0, most), rel=1e-6)
