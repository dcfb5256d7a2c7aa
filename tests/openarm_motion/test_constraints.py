# SPDX-License-Identifier: Apache-2.0
"""Regions of configurations, plans to them and in them, and Cartesian paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.constraints.asked import CartesianGoal, RegionGoal
from openarm_motion.constraints.cartesian import along
from openarm_motion.constraints.goals import in_region
from openarm_motion.constraints.names import RobotNames
from openarm_motion.constraints.plans import to_region
from openarm_motion.constraints.queries import at_pose, judge
from openarm_motion.constraints.regions import JointInterval, OrientationRegion, PositionRegion, TaskRegion, Volume
from openarm_motion.planning.moves import RequestBoxes
from tests.refusals import refused, refuses

pytestmark = pytest.mark.requirement("R-28")

NOTHING = RequestBoxes()
angles = st.floats(-1.2, 1.2)


@pytest.fixture(scope="module")
def arm(arms):
    return arms["right"]


@pytest.fixture(scope="module")
def now(arm):
    posture = arm.description.group_state("right_arm", "official_home")
    return arm.start_state({**dict.fromkeys(arm.description.joints, 0.0), **posture})


@given(st.tuples(angles, angles, angles), st.booleans())
def test_what_is_drawn_from_a_tolerance_of_orientation_is_inside(tolerance, vector: bool) -> None:
    region = OrientationRegion("link", se3.rot_x(0.3), se3.rot_z(0.5), tuple(map(abs, tolerance)), vector)
    pose = np.eye(4)
    pose[:3, :3] = region.sample(np.random.default_rng(1))
    assert region.excess(pose[None])[0] < 1e-9
    pose[:3, :3] = region.middle()
    assert region.excess(pose[None])[0] < 1e-9


@pytest.mark.parametrize(("kind", "size"), [("box", (0.1, 0.2, 0.3)), ("sphere", (0.1,)), ("cylinder", (0.2, 0.1))])
def test_what_is_drawn_from_a_volume_is_inside_and_what_is_beyond_is_not(kind, size) -> None:
    volume = Volume(kind, se3.make(se3.rot_x(0.4), (0.1, 0.2, 0.3)), size)
    rng = np.random.default_rng(2)
    points = np.array([volume.sample(rng) for _ in range(200)])
    assert volume.excess(points) == pytest.approx(np.zeros(200), abs=1e-12)
    assert volume.excess(np.array([[0.1, 0.2, 1.3]]))[0] > 0.5


def test_an_interval_without_sense_is_refused_by_name() -> None:
    refused("joint3", JointInterval, "joint3", 0.0, -0.1, 0.1)


def test_a_goal_of_joints_of_another_arm_is_refused(arm, now) -> None:
    region = TaskRegion((JointInterval("openarm_left_joint1", 0.0, 0.1, 0.1),))
    goal = TaskRegion((JointInterval(arm.names[0], 0.0, 2.0, 2.0),))
    for ask in (
        lambda: to_region(arm, now, RegionGoal((region,)), NOTHING),
        lambda: to_region(arm, now, RegionGoal((goal,), region), NOTHING),
        lambda: along(arm, now, CartesianGoal((arm.kinematics.fk(now.start),), path=region), NOTHING),
        lambda: judge(arm, now, NOTHING, region),
    ):
        assert refused("openarm_left_joint1", ask).code is Code.INVALID_ARGUMENT


@pytest.fixture
def T(arm, now) -> np.ndarray:
    """Where the tool is."""
    return arm.kinematics.fk(now.start)


def test_the_end_of_a_plan_lies_in_the_region_and_the_nearer_of_two_is_taken(T: np.ndarray, arm, now) -> None:
    near, far = T.copy(), T.copy()
    near[:3, 3] += (0.0, 0.02, 0.02)
    far[:3, 3] += (0.02, 0.1, 0.1)
    goal = RegionGoal((at_pose(near, TaskRegion()), at_pose(far, TaskRegion())))

    trajectory = to_region(arm, now, goal, NOTHING)

    assert arm.kinematics.fk(trajectory.q[-1]) == pytest.approx(near, abs=1e-3)


def test_a_position_alone_is_reached_in_whatever_orientation(T: np.ndarray, arm, now) -> None:
    p = T[:3, 3] + (0.0, 0.05, 0.05)
    region = TaskRegion(
        positions=(PositionRegion("tool", np.zeros(3), (Volume("sphere", se3.make(None, p), (1e-3,)),)),)
    )

    trajectory = to_region(arm, now, RegionGoal((region,)), NOTHING)

    assert arm.kinematics.fk(trajectory.q[-1])[:3, 3] == pytest.approx(p, abs=2e-3)


def test_poses_are_drawn_until_the_time_is_over_and_of_one_pose_there_is_nothing_to_draw(arm, now, monkeypatch) -> None:
    far = arm.kinematics.fk(now.start)
    far[0, 3] += 3.0
    place = PositionRegion("the tool", np.zeros(3), (Volume("sphere", far, (0.5,)),))
    wide = TaskRegion(positions=(place,), orientations=at_pose(far, TaskRegion()).orientations)
    tried: list[float] = []
    monkeypatch.setattr(arm.inverse, "solutions", lambda *about: tried.append(0.0) or [])

    def count(region: TaskRegion, end: float) -> int:
        tried.clear()
        refused("can't reach the goal", in_region, arm, region, now.start, end=end)
        return len(tried)

    once = count(at_pose(far, TaskRegion()), np.inf)
    assert count(wide, np.inf) > 40 * once
    assert count(wide, -np.inf) == once


def test_a_path_stays_in_its_region(T: np.ndarray, arm, now) -> None:
    there = T.copy()
    there[:3, 3] += (0.02, 0.06, 0.06)
    path = TaskRegion(orientations=(OrientationRegion("tool", np.eye(3), T[:3, :3], (0.05, 0.05, 3.2)),))

    trajectory = to_region(arm, now, RegionGoal((at_pose(there, TaskRegion()),), path), NOTHING)

    states = trajectory.at(np.linspace(0.0, trajectory.duration, 300))[0]
    assert not path.violations(arm.names, states, arm.kinematics.fk_many(states)).any()


def test_a_goal_outside_of_the_path_region_is_named(T: np.ndarray, arm, now) -> None:
    there = T @ se3.make(se3.rot_x(0.4))
    path = TaskRegion(orientations=(OrientationRegion("tool", np.eye(3), T[:3, :3], (0.05, 0.05, 0.05)),))
    with refuses(Code.VIOLATION, "the goal violates the path constraints"):
        to_region(arm, now, RegionGoal((at_pose(there, TaskRegion()),), path), NOTHING)


@pytest.mark.requirement("B-47")
def test_a_cartesian_path_goes_through_its_way_points_and_ends_before_an_obstacle(T: np.ndarray, arm, now) -> None:
    first, second = T.copy(), T.copy()
    first[2, 3] += 0.04
    second[:3, 3] += (0.0, 0.04, 0.04)
    goal = CartesianGoal((first, second))

    whole = along(arm, now, goal, NOTHING)
    wall = box_from("wall", second[:3, 3] + (0.0, 0.055, 0.0), (0.4, 0.02, 0.4))
    part = along(arm, now, goal, RequestBoxes((wall,)))

    assert whole.fraction == 1.0
    poses = arm.kinematics.fk_many(whole.q)[:, :3, 3]
    for point in (first[:3, 3], second[:3, 3]):
        assert np.linalg.norm(poses - point, axis=1).min() < 1e-3
    assert whole.v[-1] == pytest.approx(np.zeros(7))
    assert 0.0 <= part.fraction < 1.0
    assert "wall" in part.ended


@pytest.mark.parametrize("z", [1e30, float("nan")])
def test_a_way_point_out_of_all_reach_is_refused(T: np.ndarray, arm, now, z: float) -> None:
    T[2, 3] = z
    with pytest.raises(OpenArmError, match=r"the way through 1 way points is .* long, expected less than 50"):
        along(arm, now, CartesianGoal((T,)), NOTHING)


@pytest.mark.parametrize("scale", [(1e-9, 0.0), (0.0, 1e-9), (-1.0, 0.0), (float("nan"), 0.0)])
def test_a_motion_that_would_take_days_is_refused(T: np.ndarray, arm, now, scale: tuple[float, float]) -> None:
    """Its trajectory would not fit into memory."""
    T[2, 3] += 0.04
    refused(r"_scale is .*, expected 0.001 to 1", along, arm, replace(now, scale=scale), CartesianGoal((T,)), NOTHING)


def test_a_state_is_judged_by_contacts_and_constraints(T: np.ndarray, arm, now) -> None:
    other = TaskRegion(
        orientations=(OrientationRegion("tool", np.eye(3), T[:3, :3] @ se3.rot_x(0.5), (0.1, 0.1, 0.1)),)
    )
    box = box_from("box", T[:3, 3], (0.1, 0.1, 0.1))

    assert judge(arm, now, NOTHING, TaskRegion()).valid
    blocked = judge(arm, now, RequestBoxes((box,)), other)

    assert not blocked.valid
    assert {contact.second for contact in blocked.contacts} == {"box"}
    assert blocked.constraints[0][1] == pytest.approx(0.4, abs=1e-6)


def test_the_distance_from_a_constraint_counts_by_its_weight(T: np.ndarray, arm, now) -> None:
    turned = OrientationRegion("tool", np.eye(3), T[:3, :3] @ se3.rot_x(0.5), (0.1, 0.1, 0.1), weight=2.5)
    joint = JointInterval(arm.names[0], float(now.start[0]) + 0.3, 0.1, 0.1, weight=0.5)

    verdict = judge(arm, now, NOTHING, TaskRegion((joint,), (), (turned,)))

    assert [beyond for _, beyond in verdict.constraints] == pytest.approx([0.5 * 0.2, 2.5 * 0.4], abs=1e-6)


def test_more_attempts_take_the_path_that_is_followed_soonest(arm, now) -> None:
    """Of ways about a box; a straight line needs no second one."""
    q = now.start + np.array([0.9, 0.0, 0.0, 0.3, 0.0, 0.0, 0.0])
    box = box_from("box", arm.kinematics.fk(0.5 * (now.start + q))[:3, 3], (0.1, 0.1, 0.1))
    goal = RegionGoal((TaskRegion(tuple(JointInterval(n, x, 1e-3, 1e-3) for n, x in zip(arm.names, q, strict=True))),))

    def seconds(seeds: range, *boxes: Box) -> float:
        return to_region(arm, replace(now, seeds=seeds), goal, RequestBoxes(boxes)).duration

    alone = [seconds(range(k, k + 1), box) for k in range(4)]
    assert min(alone) < 0.9 * alone[0], "the seeds make a difference"
    assert seconds(range(4), box) == min(alone)
    assert seconds(range(2**31)) == seconds(range(1))


def test_groups_and_links_are_those_of_the_description(arm, arms) -> None:
    names = RobotNames(arm.description, arms)
    assert names.groups() == {"left_arm": ("left",), "right_arm": ("right",), "both_arms": ("left", "right")}
    assert set(names.hands()) == {"left_gripper", "right_gripper"}
    assert arm.kinematics.tool_link in names.links_on_tool("right")
    assert names.on_tool("right", "") == pytest.approx(np.eye(4))
    refused("planning groups: left_arm, right_arm, both_arms", names.arms_of_group, "no_such_group")
