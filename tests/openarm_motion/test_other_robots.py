# SPDX-License-Identifier: Apache-2.0
"""A UR5 and a Panda through the code of OpenArm's arms, by configuration alone."""

from __future__ import annotations

import sysconfig
from pathlib import Path

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.fast import FastScene
from openarm_motion.collision.mesh_boxes import boxes_about, load_robot
from openarm_motion.collision.solids import box_from
from openarm_motion.config import LimitsConfig, MotionConfig
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.moves import RequestBoxes, to_pose, to_pose_on_line
from openarm_motion.timing.validation import validate_trajectory

DATA = Path(sysconfig.get_paths()["purelib"]) / "cmeel.prefix" / "share" / "example-robot-data"

ROBOTS = {
    "ur5": (
        "robots/ur_description/urdf/ur5_robot.urdf",
        "robots/ur_description/srdf/ur5.srdf",
        MotionConfig(
            arms=("ur5",),
            tool_link="tool0",
            group="manipulator",
            limits=LimitsConfig(velocity=(3.1,) * 6, acceleration=(8.0,) * 6, jerk=(80.0,) * 6),
        ),
        (0.0, -1.2, 1.6, -1.9, -1.6, 0.3),
    ),
    "panda": (
        "robots/panda_description/urdf/panda_collision.urdf",
        "robots/panda_description/srdf/panda.srdf",
        MotionConfig(
            arms=("panda",),
            tool_link="panda_hand_tcp",
            group="panda_arm",
            limits=LimitsConfig(velocity=(2.1,) * 7, acceleration=(7.0,) * 7, jerk=(100.0,) * 7),
        ),
        (0.0, -0.6, 0.0, -2.2, 0.0, 1.6, 0.8),
    ),
}


@pytest.fixture(scope="module", params=list(ROBOTS))
def robot(request: pytest.FixtureRequest) -> tuple[Arm, np.ndarray]:
    """The arm and a configuration to start from."""
    if not DATA.is_dir():
        pytest.skip("example-robot-data is not installed")
    urdf, srdf, config, start = ROBOTS[request.param]
    description = load_robot(DATA / urdf, DATA / srdf, {"example-robot-data": DATA})
    return Arm(request.param, description, config), np.array(start)


@pytest.mark.requirement("B-13")
def test_every_reachable_pose_is_solved(robot: tuple[Arm, np.ndarray]) -> None:
    chain = robot[0].kinematics
    states = np.random.default_rng(13).uniform(chain.lower, chain.upper, (300, chain.n))
    for target in chain.fk_many(states):
        found = chain.ik(target, tolerance=(1e-4, 1e-3))
        assert found.success
        assert chain.margin(found.q) >= -1e-9
        np.testing.assert_allclose(chain.fk(found.q)[:3, 3], target[:3, 3], atol=1e-4)


@pytest.mark.requirement("B-13")
def test_the_fast_layer_is_never_more_generous(robot: tuple[Arm, np.ndarray]) -> None:
    arm, _ = robot
    exact = arm.scene({}, [box_from("post", (0.45, 0.1, 0.4), (0.1, 0.1, 0.8))])
    states = np.random.default_rng(14).uniform(arm.kinematics.lower, arm.kinematics.upper, (1000, arm.kinematics.n))
    free = FastScene([exact]).free_many(states)
    truth = np.array([not exact.collides(q) for q in states])
    assert not np.any(free & ~truth)
    assert int(np.sum(free)) > 0.9 * int(np.sum(truth)) > 300


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


def test_boxes_hold_every_point_of_a_mesh() -> None:
    """An L of thin triangles: smaller than one box, and no point is outside."""
    rng = np.random.default_rng(3)
    a, b = (
        rng.uniform((0.0, 0.0, 0.0), (1.0, 0.1, 0.1), (60, 3, 3)),
        rng.uniform((0, 0, 0), (0.1, 0.1, 0.8), (60, 3, 3)),
    )
    triangles = np.concatenate([a, b])
    boxes = boxes_about(triangles)
    weights = rng.dirichlet((1.0, 1.0, 1.0), (120, 200))
    points = np.einsum("nkc,ncd->nkd", weights, triangles).reshape(-1, 3)
    inside = np.zeros(len(points), np.bool_)
    for low, high in boxes:
        inside |= np.all((points >= low - 1e-9) & (points <= high + 1e-9), axis=1)
    assert inside.all()
    assert sum(float(np.prod(high - low)) for low, high in boxes) < 0.5 * float(np.prod(np.ptp(points, axis=0)))


def test_a_mesh_of_an_unknown_package_is_refused_by_name(tmp_path: Path) -> None:
    urdf = tmp_path / "r.urdf"
    urdf.write_text(
        '<robot name="r"><link name="a"><collision><geometry><mesh filename="package://nobody/a.stl"/>'
        "</geometry></collision></link></robot>",
        encoding="utf-8",
    )
    with pytest.raises(OpenArmError, match="'nobody' has no folder; packages with one: none") as caught:
        load_robot(urdf)
    assert caught.value.code == Code.CONFIG_INVALID
    with pytest.raises(OpenArmError, match="there is no file"):
        load_robot(tmp_path / "none.urdf")
