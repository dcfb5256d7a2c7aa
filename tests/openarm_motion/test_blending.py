# SPDX-License-Identifier: Apache-2.0
"""Timings without stops, and quintic ones."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_motion.collision.solids import box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.planner import PlannedPath
from openarm_motion.timing import blending
from openarm_motion.timing.blending import time_blended, time_quintic
from openarm_motion.timing.trajectory import SPACING, JointLimits, Trajectory, time_polyline
from openarm_motion.timing.validation import validate_trajectory

NAMES = tuple(f"j{i}" for i in range(3))
LIMITS = JointLimits(np.array([2.0, 2.0, 3.0]), np.array([6.0, 8.0, 12.0]), np.array([60.0, 80.0, 120.0]))
CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.1, 1.2, 0.4], [2.0, 1.0, 0.2]])


def excess(trajectory: Trajectory, limits: JointLimits) -> list[float]:
    """Greatest share of each limit that is used; the jerk by differences within samples."""
    t = np.linspace(0.0, trajectory.duration, 6000)
    _, v, a = trajectory.at(t)
    jerk = np.diff(trajectory.a, axis=0) / np.diff(trajectory.t)[:, None]
    used = zip((v, a, jerk), (limits.velocity, limits.acceleration, limits.jerk), strict=True)
    return [float(np.max(np.abs(value) / limit)) for value, limit in used]


@settings(max_examples=40)
@given(st.lists(st.lists(st.floats(-2.5, 2.5), min_size=3, max_size=3), min_size=2, max_size=6))
def test_blends_hold_limits_and_stay_in_the_corners_triangles(points: list[list[float]]) -> None:
    waypoints = np.array(points)
    trajectory = time_blended(NAMES, waypoints, LIMITS)
    velocity, acceleration, jerk = excess(trajectory, LIMITS)
    assert max(velocity, jerk) <= 1.0 + 2e-3
    # borders of pieces nearer to each other than 1 ms are one sample: between samples that is 1 ms of jerk
    assert acceleration <= 1.0 + SPACING * float(np.max(LIMITS.jerk / LIMITS.acceleration))
    np.testing.assert_allclose(trajectory.q[[0, -1]], waypoints[[0, -1]], atol=1e-9)
    assert not np.any(trajectory.v[[0, -1]])
    assert not np.any(trajectory.a[[0, -1]])
    assert trajectory.duration <= time_polyline(NAMES, waypoints, LIMITS).duration + 1e-6
    low, high = waypoints.min(axis=0), waypoints.max(axis=0)
    q = trajectory.at(np.linspace(0.0, trajectory.duration, 500))[0]
    assert np.all(q >= low - 1e-5)
    assert np.all(q <= high + 1e-5)


def test_a_corner_is_faster_without_a_stop_and_moves_through_it() -> None:
    stops, blended = time_polyline(NAMES, CORNER, LIMITS), time_blended(NAMES, CORNER, LIMITS)
    assert blended.duration < 0.9 * stops.duration
    one = time_blended(NAMES, CORNER[:3], LIMITS)
    inner = one.at(np.linspace(0.2, one.duration - 0.2, 2000))[1]
    assert float(np.min(np.linalg.norm(inner, axis=1))) > 0.05


def test_a_way_back_stops() -> None:
    """Both halves push the same way in the corner: together they would exceed the limit, so they don't overlap much."""
    there_and_back = np.array([[0.0, 0, 0], [1.0, 0, 0], [0.0, 0, 0]])
    assert max(excess(time_blended(NAMES, there_and_back, LIMITS), LIMITS)) <= 1.0 + 2e-3


@pytest.mark.parametrize("size", [1e-4, 0.02, 0.5, 3.0])
@pytest.mark.requirement("A-67")
def test_quintic_begins_and_ends_at_rest_and_touches_one_limit(size: float) -> None:
    waypoints = np.array([[0.0, 0.0, 0.0], [size, -0.4 * size, 0.1 * size]])
    trajectory = time_quintic(NAMES, waypoints, LIMITS, 0.004)
    ends = np.array([0, -1])
    assert not np.any(np.abs(trajectory.v[ends]) > 1e-12)
    assert not np.any(np.abs(trajectory.a[ends]) > 1e-12)
    t = np.linspace(0.0, trajectory.duration, 4001)
    q, v, a = trajectory.at(t)
    jerk = np.gradient(a, t, axis=0)
    used = [
        float(np.max(np.abs(x) / limit))
        for x, limit in ((v, LIMITS.velocity), (a, LIMITS.acceleration), (jerk, LIMITS.jerk))
    ]
    assert max(used) == pytest.approx(1.0, abs=2e-3)
    np.testing.assert_allclose(np.gradient(q, t, axis=0)[1:-1], v[1:-1], atol=1e-3 * (1 + size))
    np.testing.assert_allclose(q[-1], waypoints[-1], atol=1e-12)


def test_corners_of_plans_are_rounded_only_where_the_exact_layer_agrees(right: Arm, home: dict[str, float]) -> None:
    boxes = [box_from(f"post{i}", (0.36, y, 0.65), (0.03, 0.03, 0.5)) for i, y in enumerate((-0.42, -0.2, 0.2))]
    boxes.append(box_from("board", (0.40, 0.0, 0.85), (0.25, 1.0, 0.03)))
    scene = right.scene(home, boxes)
    rng = np.random.default_rng(31)
    states = rng.uniform(right.kinematics.lower, right.kinematics.upper, (400, 7))
    states = [q for q in states if not scene.collides(q)][:24]
    corners = gained = 0
    for start, goal in itertools.pairwise(states):
        plan = right.plan_validated(scene, StartState(home, start), goal[None], 5.0)
        if len(plan.path.waypoints) == 2:
            continue
        corners += 1
        stops = time_polyline(right.names, plan.path.waypoints, right.limits(0.0))
        gained += plan.trajectory.duration < 0.97 * stops.duration
        assert plan.trajectory.duration <= stops.duration + 1e-6
        validate_trajectory(scene, plan.trajectory, travel=0.003)
    assert corners >= 3
    assert gained >= 2


def test_a_rounded_corner_that_touches_is_done_with_a_stop(
    right: Arm, home: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is rounded may not be what was planned: a timing that fails the validation gives way to the next one."""
    scene = right.scene(home)
    start = np.array([home[name] for name in right.names])
    path = PlannedPath(np.stack([start, start + 0.05, start]), 0, 2)
    into = next(
        q
        for q in np.random.default_rng(5).uniform(right.kinematics.lower, right.kinematics.upper, (500, 7))
        if scene.collides(q)
    )
    astray = time_polyline(right.names, np.stack([start, into]), right.limits(0.0))
    monkeypatch.setattr(blending, "time_blended", lambda *_: astray)
    monkeypatch.setattr(right, "plan", lambda *_: path)
    plan = right.plan_validated(scene, StartState(home, start), start[None], 5.0)
    np.testing.assert_allclose(plan.trajectory.q[-1], start)
    assert not np.any(np.max(np.abs(plan.trajectory.q - start), axis=1) > 0.06)
