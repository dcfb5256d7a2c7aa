# SPDX-License-Identifier: Apache-2.0
"""Jerk-limited timing."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_motion.kinematics.line import solve_line
from openarm_motion.planning.arm import Arm
from openarm_motion.timing.speed_kernels import SPACING
from openarm_motion.timing.trajectory import JointLimits, Trajectory, profile, time_path, time_polyline
from tests.openarm_motion.conftest import ruckig_duration, shares_of_limits
from tests.refusals import refused

NAMES = tuple(f"j{i}" for i in range(7))
LIMITS = JointLimits(
    np.array([2.0, 2.0, 2.5, 2.5, 3.0, 3.0, 3.0]),
    np.array([6.0, 6.0, 8.0, 8.0, 12.0, 12.0, 12.0]),
    np.array([60.0, 60.0, 80.0, 80.0, 120.0, 120.0, 120.0]),
)


def assert_within_limits(trajectory: Trajectory, limits: JointLimits) -> None:
    """By the polynomials themselves, and by finite differences of what is interpolated."""
    assert max(shares_of_limits(trajectory, limits)) <= 1.0 + 1e-6
    assert np.all(trajectory.v[[0, -1]] == 0.0)
    assert np.all(np.abs(trajectory.a[[0, -1]]) < 1e-9)
    t = np.linspace(0.0, trajectory.duration, max(2000, int(trajectory.duration / 5e-4)))
    q, v, a = trajectory.at(t)
    h = t[1] - t[0]
    np.testing.assert_allclose(np.diff(q, axis=0) / h, 0.5 * (v[1:] + v[:-1]), atol=2e-4)
    np.testing.assert_allclose(np.diff(v, axis=0) / h, 0.5 * (a[1:] + a[:-1]), atol=0.05)


@settings(max_examples=8)
@given(st.lists(st.lists(st.floats(-1.5, 1.5), min_size=7, max_size=7), min_size=2, max_size=4), st.floats(0.1, 1.0))
def test_polylines_are_exact_and_within_limits_at_every_sample(points: list[list[float]], scale: float) -> None:
    waypoints = np.array(points)
    limits = LIMITS.scaled(scale)
    trajectory = time_polyline(NAMES, waypoints, limits)
    assert_within_limits(trajectory, limits)
    np.testing.assert_array_equal(trajectory.q[0], waypoints[0])
    np.testing.assert_allclose(trajectory.q[-1], waypoints[-1], atol=1e-9)
    q, _, _ = trajectory.at(np.linspace(0.0, trajectory.duration, 300))
    for point in q:
        assert min(_distance(point, a, b) for a, b in itertools.pairwise(waypoints)) < 1e-6


def _distance(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> float:
    d = b - a
    u = np.clip((p - a) @ d / max(d @ d, 1e-12), 0.0, 1.0)
    return float(np.linalg.norm(p - a - u * d))


def test_a_single_segment_is_as_fast_as_the_limits_allow() -> None:
    goal = np.array([1.0, 0.2, 0, 0, 0, 0, 0])
    trajectory = time_polyline(NAMES, np.stack([np.zeros(7), goal]), LIMITS)
    # v 2, a 6, j 60: ramp of v/a + a/j = 0.433 s, so 1 rad takes 1/2 + 0.433 s
    assert trajectory.duration == pytest.approx(0.5 + 2.0 / 6.0 + 6.0 / 60.0, abs=2e-5)
    assert np.max(np.abs(trajectory.v[:, 0])) == pytest.approx(2.0, abs=1e-6)


def test_samples_are_exact_for_a_quintic_follower() -> None:
    waypoints = np.array([np.zeros(7), [0.8, -0.3, 0.2, 0.9, -0.5, 0.1, 0.6]])
    coarse, fine = (time_polyline(NAMES, waypoints, LIMITS, period) for period in (0.1, 0.004))
    t = np.linspace(0.0, coarse.duration, 777)
    np.testing.assert_allclose(coarse.at(t)[0], fine.at(t)[0], atol=1e-12)
    np.testing.assert_allclose(coarse.at(t)[1], fine.at(t)[1], atol=1e-9)
    assert np.diff(coarse.t).min() > 5e-4


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.1])
def test_straight_lines_hold_limits_and_speed(right: Arm, home: dict[str, float], scale: float) -> None:
    start = right.inverse.classify([home[name] for name in right.names])
    T = right.kinematics.fk(start.q)
    limits = right.limits(scale)
    for direction in ((0.0, 0.0, -0.12), (0.06, 0.05, -0.10), (-0.08, 0.0, 0.0)):
        goal = T.copy()
        goal[:3, 3] += direction
        line = solve_line(right.inverse, start, T, goal, 0.0)
        trajectory = time_path(right.names, line.q, line.s, limits, 0.25 * scale)
        assert_within_limits(trajectory, limits)
        tool = right.kinematics.fk_many(trajectory.at(np.linspace(0, trajectory.duration, 400))[0])[:, :3, 3]
        speed = np.linalg.norm(np.diff(tool, axis=0), axis=1) / (trajectory.duration / 399)
        assert speed.max() <= 0.25 * scale * 1.01
        along = np.array(direction) / np.linalg.norm(direction)
        offset = tool - T[:3, 3]
        assert np.abs(offset - np.outer(offset @ along, along)).max() < 1e-5


def test_a_fast_bend_is_slowed_down_until_limits_hold() -> None:
    u = np.linspace(0.0, 1.0, 60)
    path = np.stack([np.sin(6.0 * u * (i + 1) / 7) for i in range(7)], axis=1)
    trajectory = time_path(NAMES, path, u, LIMITS, 100.0)
    assert_within_limits(trajectory, LIMITS)


def test_no_way_is_a_rest() -> None:
    q = np.full(7, 0.3)
    trajectory = time_polyline(NAMES, np.stack([q, q]), LIMITS)
    assert trajectory.duration > 0.0
    np.testing.assert_array_equal(trajectory.q, [q, q])
    np.testing.assert_array_equal(trajectory.at(0.5)[0], [q])


@settings(max_examples=40)
@given(st.floats(1e-6, 10), st.floats(1e-2, 10), st.floats(1e-2, 50), st.floats(1e-1, 500))
def test_a_profile_goes_its_length_within_its_limits(length: float, v: float, a: float, j: float) -> None:
    way = profile(length, v, a, j)
    t = np.linspace(0.0, way.duration, 200)
    s, ds, dds, ddds = (x[:, 0] for x in way.at(t))
    assert s[-1] == pytest.approx(length, rel=1e-6, abs=1e-9)
    assert np.abs(ds).max() <= v * (1 + 1e-6)
    assert np.abs(dds).max() <= a * (1 + 1e-6)
    assert np.abs(ddds).max() <= j * (1 + 1e-6)
    assert np.all(np.diff(s) >= -1e-9)
    # no piece is shorter than 1 ms: that costs two of them at most
    best = ruckig_duration(length, np.array([v, a, j]))
    assert best - 1e-9 <= way.duration <= best + 2 * SPACING


def test_impossible_limits_are_refused() -> None:
    refused("expected 0 < scale <= 1", LIMITS.scaled, 1.5)
    refused("expected all > 0", profile, 1.0, 0.0, 1.0, 1.0)
