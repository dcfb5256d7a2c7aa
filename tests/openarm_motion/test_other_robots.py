# SPDX-License-Identifier: Apache-2.0
"""A UR5e and a Panda through the code of OpenArm's arms, by their folders alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.robot_models import ROBOTS, TrueMeshes, load_arm, states_of
from benchmarks.robot_problems import FAMILIES, problems
from openarm_common import se3
from openarm_motion.collision.solids import box_from
from openarm_motion.config import MotionConfig, MotionLimits
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.moves import RequestBoxes, to_pose, to_pose_on_line
from openarm_motion.planning.rrt import FastPlanner
from openarm_motion.timing.validation import validate_trajectory


@pytest.fixture(scope="module", params=list(ROBOTS))
def robot(request: pytest.FixtureRequest) -> tuple[Arm, np.ndarray]:
    """The arm and a configuration to start from."""
    return load_arm(request.param), np.array(ROBOTS[request.param].start)


@pytest.mark.requirement("B-07")
def test_a_pose_is_planned_around_a_post_within_the_limits(robot: tuple[Arm, np.ndarray]) -> None:
    arm, start = robot
    names = dict(zip(arm.names, start.tolist(), strict=True))
    here = arm.kinematics.fk(start)
    turned = se3.make(se3.rot_z(1.2), (0.0, 0.0, 0.0)) @ here
    p = 0.5 * (here[:3, 3] + turned[:3, 3])
    post = box_from("post", (p[0], p[1], 0.5 * p[2] + 0.05), (0.06, 0.06, p[2] + 0.1))
    now = StartState(names, start, 0.8)
    trajectory = to_pose(arm, now, turned, RequestBoxes([post]))
    np.testing.assert_allclose(arm.kinematics.fk(trajectory.q[-1]), turned, atol=1e-3)
    validate_trajectory(arm.scene(names, [post]), trajectory)
    limits = arm.limits(0.8)
    _, v, a = trajectory.at(np.linspace(0.0, trajectory.duration, 2000))
    assert np.all(np.abs(v) <= limits.velocity * 1.001)
    assert np.all(np.abs(a) <= limits.acceleration * 1.001)


@pytest.mark.requirement("B-07")
def test_a_straight_line_stays_on_it(robot: tuple[Arm, np.ndarray]) -> None:
    arm, start = robot
    now = StartState(dict(zip(arm.names, start.tolist(), strict=True)), start)
    here = arm.kinematics.fk(start)
    there = here.copy()
    there[:3, 3] += (0.02, 0.03, 0.08)
    trajectory = to_pose_on_line(arm, now, there, RequestBoxes())
    p = arm.kinematics.fk_many(trajectory.at(np.linspace(0.0, trajectory.duration, 300))[0])[:, :3, 3]
    along = (there - here)[:3, 3] / np.linalg.norm((there - here)[:3, 3])
    off = (p - here[:3, 3]) - np.outer((p - here[:3, 3]) @ along, along)
    assert float(np.max(np.linalg.norm(off, axis=1))) < 5e-4
    np.testing.assert_allclose(p[-1], there[:3, 3], atol=1e-4)


@pytest.mark.requirement("B-07", "R-30")
@pytest.mark.parametrize("name", list(ROBOTS))
def test_problems_are_solved_and_no_path_touches_the_triangles_of_the_meshes(name: str) -> None:
    arm = load_arm(name, touching=True)
    judge = TrueMeshes(name)
    for family in FAMILIES:
        for problem in problems(name, family, 1, 2, arm.kinematics, judge):
            scene = arm.scene({}, problem.obstacles)  # pyright: ignore[reportArgumentType]
            now = StartState({}, problem.start)
            path = FastPlanner().plan(arm.query(scene, now, problem.goals, 20.0)).waypoints
            hits = judge.around(problem.obstacles)
            assert not any(hits(q) for q in states_of(path, 0.02)), family


def test_plans_keep_the_speeds_of_the_description_where_the_folder_rounds_them_up(description) -> None:
    """1.4 rad/s of a folder, 1.3963 of its URDF: the controllers, which read the URDF, refuse more. 0: not known."""
    names = description.arm_joints("right")
    slower = [replace(description.joint(names[0]), velocity=1.3963), replace(description.joint(names[1]), velocity=0.0)]
    limits = MotionLimits(velocity=(1.4,) * 7, acceleration=(6.0,) * 7, jerk=(60.0,) * 7)
    arm = Arm("right", description._with_joints(*slower), MotionConfig(limits=limits))
    np.testing.assert_array_equal(arm.limits(1.0).velocity, [1.3963, *(1.4,) * 6])
