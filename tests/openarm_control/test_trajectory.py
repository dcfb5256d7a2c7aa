# SPDX-License-Identifier: Apache-2.0
"""Trajectories: what is refused and how it is named; the spline passes its points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common.errors import Code
from openarm_control.trajectory import JointGroup, JointSpline, Trajectory, TrajectoryError, TrajectoryResult, checked

GROUP = JointGroup(("j1", "j2"), np.array([-1.0, -2.0]), np.array([1.0, 2.0]), np.array([4.0, 4.0]))
T2 = np.array([0.5, 1.0])
Q2 = np.array([[0.1, 0.2], [0.3, 0.4]])


def trajectory(**changes) -> Trajectory:
    return Trajectory(**({"names": ("j1", "j2"), "t": T2, "q": Q2} | changes))


def test_columns_are_put_in_the_order_of_the_joints() -> None:
    fixed = checked(trajectory(names=("j2", "j1"), v=np.array([[1.0, 2.0], [0.0, 0.0]])), GROUP)
    np.testing.assert_array_equal(fixed.q, Q2[:, ::-1])
    np.testing.assert_array_equal(fixed.v, [[2.0, 1.0], [0.0, 0.0]])
    assert fixed.names == GROUP.names


@pytest.mark.parametrize(
    ("changes", "code", "result", "message"),
    [
        (
            {"names": ("j1", "j9")},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_JOINTS,
            "unknown joint 'j9'.*expected each of j1, j2",
        ),
        ({"names": ("j1", "j1")}, Code.INVALID_ARGUMENT, TrajectoryResult.INVALID_JOINTS, "duplicate joint 'j1'"),
        (
            {"names": ("j1",), "q": Q2[:, :1]},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_JOINTS,
            "missing joint 'j2'",
        ),
        ({"t": np.zeros(0), "q": np.zeros((0, 2))}, Code.INVALID_ARGUMENT, TrajectoryResult.INVALID_GOAL, "no points"),
        (
            {"q": np.array([[0.1, 0.2], [np.nan, 0.4]])},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "position of j1 at point 1 is nan",
        ),
        (
            {"q": np.array([[0.1, 0.2], [0.3, np.inf]])},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "position of j2 at point 1 is inf",
        ),
        (
            {"v": np.array([[np.nan, 0.0], [0.0, 0.0]])},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "velocity of j1 at point 0 is nan",
        ),
        (
            {"q": np.array([[0.1, 0.2], [1.5, 0.4]])},
            Code.LIMITS,
            TrajectoryResult.INVALID_GOAL,
            r"position of j1 at point 1 is 1\.5000, out of its limits -1\.0000 to 1\.0000",
        ),
        (
            {"t": np.array([1.0, 1.0])},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "time of point 1 .* strictly increasing",
        ),
        ({"t": np.array([-0.1, 1.0])}, Code.INVALID_ARGUMENT, TrajectoryResult.INVALID_GOAL, "time of point 0 is -0.1"),
        (
            {"t": np.array([0.5, 0.51])},
            Code.LIMITS,
            TrajectoryResult.INVALID_GOAL,
            r"j1 would have to move at 20\.00 rad/s between point 0 and the next",
        ),
        (
            {"v": np.array([[0.0, 9.0], [0.0, 0.0]])},
            Code.LIMITS,
            TrajectoryResult.INVALID_GOAL,
            r"j2 would have to move at 9\.00 rad/s at point 0",
        ),
        (
            {"v": np.array([[0.0, 0.0], [0.5, 0.0]])},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "velocity of j1 at the last point is 0.500",
        ),
        (
            {"path_tolerance": {"j7": 0.1}},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            "path tolerance 0.1 of joint 'j7'",
        ),
        (
            {"q": np.zeros((3, 2))},
            Code.INVALID_ARGUMENT,
            TrajectoryResult.INVALID_GOAL,
            r"position array of shape \(3, 2\)",
        ),
    ],
)
@pytest.mark.requirement("P-21")
def test_bad_trajectories_are_refused_with_joint_and_value(
    changes: dict, code: Code, result: TrajectoryResult, message: str
) -> None:
    with pytest.raises(TrajectoryError, match=message) as caught:
        checked(trajectory(**changes), GROUP)
    assert (caught.value.code, caught.value.result) == (code, result)


numbers = st.floats(-2.0, 2.0)


@settings(max_examples=30)
@given(
    q=st.lists(st.tuples(numbers, numbers), min_size=2, max_size=6),
    v=st.lists(st.tuples(numbers, numbers), min_size=6, max_size=6),
    a=st.lists(st.tuples(numbers, numbers), min_size=6, max_size=6),
    gaps=st.lists(st.floats(0.2, 2.0), min_size=6, max_size=6),
    degree=st.sampled_from([1, 3, 5]),
)
def test_the_spline_passes_its_points_with_their_velocities(q, v, a, gaps, degree) -> None:
    n = len(q)
    t = np.cumsum(gaps[:n])
    q, v, a = np.array(q), np.array(v[:n]), np.array(a[:n])
    spline = JointSpline(t, q, v if degree > 1 else None, a if degree > 3 else None)
    for i in range(n):
        position, velocity = spline.sample(float(t[i]))
        np.testing.assert_allclose(position, q[i], atol=1e-9)
        if degree > 1 and i < n - 1:
            np.testing.assert_allclose(velocity, v[i], atol=1e-9)
    e = 1e-7
    for i in range(1, n - 1):  # continuous from either side; with accelerations given, up to these
        before, after = spline.sample(float(t[i]) - e), spline.sample(float(t[i]) + e)
        np.testing.assert_allclose(before[0], after[0], atol=1e-4)
        if degree > 1:
            np.testing.assert_allclose(before[1], after[1], atol=1e-3)
        if degree == 5:
            slope = (after[1] - spline.sample(float(t[i]))[1]) / e
            np.testing.assert_allclose(slope, a[i], atol=1e-2)


@pytest.mark.requirement("P-21")
def test_the_curve_is_of_the_degree_that_the_points_give() -> None:
    """As joint_trajectory_controller: straight, cubic, quintic; here from rest to rest, at a quarter of the time."""
    t, q, rest = np.array([0.0, 1.0]), np.array([[0.0], [1.0]]), np.zeros((2, 1))
    for derivatives, expected in (((), 0.25), ((rest,), 0.15625), ((rest, rest), 0.103515625)):
        position, _ = JointSpline(t, q, *derivatives).sample(0.25)
        np.testing.assert_allclose(position, expected)


def test_the_spline_rests_before_and_after() -> None:
    spline = JointSpline(T2, Q2, np.ones((2, 2)))
    for t, q in ((0.0, Q2[0]), (5.0, Q2[1])):
        position, velocity = spline.sample(t)
        np.testing.assert_array_equal(position, q)
        np.testing.assert_array_equal(velocity, 0.0)


def test_velocity_is_the_derivative_of_position() -> None:
    rng = np.random.default_rng(0)
    spline = JointSpline(np.array([0.0, 0.7, 1.5]), *rng.normal(size=(3, 3, 2)))
    for t in np.linspace(0.05, 1.45, 29):
        slope = (spline.sample(t + 1e-6)[0] - spline.sample(t - 1e-6)[0]) / 2e-6
        np.testing.assert_allclose(spline.sample(t)[1], slope, atol=1e-5)
