# SPDX-License-Identifier: Apache-2.0
"""Timings without stops, and quintic ones."""

from __future__ import annotations

import itertools
import math
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_motion.collision.solids import box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import DualArm
from openarm_motion.planning.planner import PlannedPath
from openarm_motion.timing import blending
from openarm_motion.timing.blending import PolylineTiming, time_quintic
from openarm_motion.timing.speed_kernels import SPACING
from openarm_motion.timing.trajectory import JointLimits, Trajectory, time_polyline
from openarm_motion.timing.validation import validate_trajectory
from tests.openarm_motion.conftest import shares_of_limits

NAMES = tuple(f"j{i}" for i in range(3))
LIMITS = JointLimits(np.array([2.0, 2.0, 3.0]), np.array([6.0, 8.0, 12.0]), np.array([60.0, 80.0, 120.0]))
CORNER = np.array([[0.0, 0.0, 0.0], [1.0, 0.1, 0.0], [1.1, 1.2, 0.4], [2.0, 1.0, 0.2]])


def corners(joints: int) -> st.SearchStrategy[np.ndarray]:
    """Polylines: far and near way points, some joints at rest, ways back, the same point twice."""
    value = st.one_of(st.floats(-2.5, 2.5), st.sampled_from([0.0, 1.0, -1.0, 1e-3, 1e-8]))
    point = st.lists(value, min_size=joints, max_size=joints)
    return st.lists(point, min_size=2, max_size=7).map(np.array)


def in_box(trajectory: Trajectory, waypoints: np.ndarray) -> bool:
    """Whether it stays in the box about the way points."""
    q = trajectory.at(np.linspace(0.0, trajectory.duration, 500))[0]
    return bool(np.all(q >= waypoints.min(axis=0) - 1e-9) and np.all(q <= waypoints.max(axis=0) + 1e-9))


@pytest.mark.long
@pytest.mark.requirement("R-31")
@given(
    data=st.data(),
    sides=st.sampled_from([("right",), ("left", "right")]),
    scale=st.sampled_from([0.1, 0.5, 1.0]),
    how=st.sampled_from(["blended", "stops", "quintic"]),
)
@settings(max_examples=12)
def test_limits_hold_everywhere_for_one_arm_and_both(
    arms: dict[str, Arm],
    data: st.DataObject,
    sides: tuple[str, ...],
    scale: float,
    how: Literal["blended", "stops", "quintic"],
) -> None:
    group = arms["right"] if len(sides) == 1 else DualArm(arms["left"], arms["right"])
    waypoints, limits = data.draw(corners(len(group.names))), group.limits(scale)
    timing = PolylineTiming(how, group.names, waypoints, limits, 0.02)
    trajectory = timing.trajectory()
    assert max(shares_of_limits(trajectory, limits)) <= 1.0 + 1e-6
    np.testing.assert_array_equal(trajectory.q[0], waypoints[0])
    np.testing.assert_allclose(trajectory.q[-1], waypoints[-1], atol=1e-9)
    assert not np.any(trajectory.v[[0, -1]])
    assert not np.any(trajectory.a[[0, -1]])
    # as messages have it: whole nanoseconds
    np.testing.assert_allclose(trajectory.t * 1e9, np.round(trajectory.t * 1e9), rtol=1e-15, atol=1e-6)
    assert np.diff(trajectory.t).min() >= SPACING - 1e-9
    assert in_box(trajectory, waypoints)
    if how == "blended":
        assert trajectory.duration <= time_polyline(group.names, waypoints, limits).duration + 1e-6


@settings(max_examples=10)
@given(corners(3))
def test_a_corner_that_is_rounded_less_is_nearer_to_the_path_and_at_last_on_it(waypoints: np.ndarray) -> None:
    timing = PolylineTiming("blended", NAMES, waypoints, LIMITS, 0.02)
    durations = [timing.trajectory().duration]
    while timing.round_less(math.nan):
        durations.append(timing.trajectory().duration)
    stops = time_polyline(NAMES, waypoints, LIMITS)
    assert durations[-1] == stops.duration
    assert durations[0] <= durations[-1] + 1e-6
    np.testing.assert_array_equal(timing.trajectory().q, stops.q)


def test_the_corner_next_to_a_fault_is_rounded_less_and_no_other_one() -> None:
    timing = PolylineTiming("blended", NAMES, CORNER, LIMITS, 0.02)
    whole = timing.trajectory()
    speed = np.linalg.norm(whole.v, axis=1)
    near = [whole.t[np.argmin(np.linalg.norm(whole.q - corner, axis=1))] for corner in CORNER[1:-1]]
    for _ in range(3):
        assert timing.round_less(float(near[1]))
    one = timing.trajectory()
    slow = [float(np.linalg.norm(one.at(one.t[np.argmin(np.linalg.norm(one.q - c, axis=1))])[1])) for c in CORNER[1:-1]]
    assert slow[0] > 0.3 * float(speed.max())
    assert slow[1] < 0.05
    assert whole.duration < one.duration < time_polyline(NAMES, CORNER, LIMITS).duration


def test_a_corner_is_faster_without_a_stop_and_moves_through_it() -> None:
    stops = time_polyline(NAMES, CORNER, LIMITS)
    blended = PolylineTiming("blended", NAMES, CORNER, LIMITS, 0.02).trajectory()
    assert blended.duration < 0.8 * stops.duration
    inner = blended.at(np.linspace(0.2, blended.duration - 0.2, 2000))[1]
    assert float(np.min(np.linalg.norm(inner, axis=1))) > 0.05


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
    drawn = rng.uniform(right.kinematics.lower, right.kinematics.upper, (400, 7))
    states = itertools.islice((q for q in drawn if not scene.collides(q)), 24)
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
    timed = blending.time_rounded
    monkeypatch.setattr(
        blending, "time_rounded", lambda *args: (astray, np.zeros(3)) if args[3].any() else timed(*args)
    )
    monkeypatch.setattr(right, "plan", lambda *_: path)
    plan = right.plan_validated(scene, StartState(home, start), start[None], 5.0)
    np.testing.assert_allclose(plan.trajectory.q[-1], start)
    assert not np.any(np.max(np.abs(plan.trajectory.q - start), axis=1) > 0.06)
