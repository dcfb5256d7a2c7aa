# SPDX-License-Identifier: Apache-2.0
"""Timings without stops, and quintic ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_motion.blending import time_blended, time_quintic
from openarm_motion.trajectory import JointLimits, Trajectory, time_polyline

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


@settings(max_examples=40, deadline=None)
@given(st.lists(st.lists(st.floats(-2.5, 2.5), min_size=3, max_size=3), min_size=2, max_size=6))
def test_blends_hold_limits_and_stay_in_the_corners_triangles(points: list[list[float]]) -> None:
    waypoints = np.array(points)
    trajectory = time_blended(NAMES, waypoints, LIMITS)
    assert max(excess(trajectory, LIMITS)) <= 1.0 + 2e-3
    np.testing.assert_allclose(trajectory.q[[0, -1]], waypoints[[0, -1]], atol=1e-9)
    assert not np.any(trajectory.v[[0, -1]])
    assert not np.any(trajectory.a[[0, -1]])
    assert trajectory.duration <= time_polyline(NAMES, waypoints, LIMITS).duration + 1e-6
    low, high = waypoints.min(axis=0), waypoints.max(axis=0)
    q = trajectory.at(np.linspace(0.0, trajectory.duration, 500))[0]
    assert np.all(q >= low - 1e-6)
    assert np.all(q <= high + 1e-6)


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
def test_a67_quintic_begins_and_ends_at_rest_and_touches_one_limit(size: float) -> None:
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
