# SPDX-License-Identifier: Apache-2.0
"""Where arms grasp on a table, and postures there, found for a robot of which both are known."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import load_folder
from openarm_motion.config import MotionConfig
from openarm_motion.planning.workplace import grasp_region, postures
from openarm_motion.service.motion_service import make_arms, table_box
from tests.refusals import refused


@pytest.fixture(scope="module")
def panda():
    work = load_folder("panda")[1].work
    assert work is not None
    robot = RobotDescription.load("panda")
    return make_arms(MotionConfig(), robot, (table_box(work.table),), {}), work, dict.fromkeys(robot.joints, 0.0)


def test_the_region_of_the_panda_is_found(panda):
    arms, work, zero = panda
    state = zero | arms["panda"].description.group_state("panda_arm", "home")
    found = grasp_region(arms, work.table, state)
    assert found.x[0] <= work.region.x[0] + 0.04
    assert found.x[1] >= work.region.x[1] - 0.04
    assert found.abs_y[0] == 0.0
    assert found.abs_y[1] >= work.region.abs_y[1]


def test_postures_over_the_table_are_free_and_home_hides_nothing_of_it(panda):
    arms, work, zero = panda
    eye = np.array([0.85, 0.0, 1.20])
    arm = arms["panda"]
    found = postures(arms, work.table, work.region, eye, zero)
    scene = arm.scene(zero, gripper=arm.opened)
    for name in ("home", "over_table"):
        assert not scene.collides(found[name]["panda"])
    over = arm.kinematics.fk(np.array(found["over_table"]["panda"]))
    np.testing.assert_allclose(over[:3, 3], (0.48, 0.0, work.table.top_z + 0.22), atol=1e-3)
    assert over[2, 2] == pytest.approx(-1.0, abs=1e-3)
    home = arm.kinematics.fk(np.array(found["home"]["panda"]))[:3, 3]
    assert home[0] < work.region.x[0] + 0.05
    assert home[2] > work.table.top_z + 0.25


def test_a_table_out_of_reach_is_said(panda):
    arms, work, zero = panda
    far = work.table.model_copy(update={"x": (1.2, 1.6)})
    error = refused(
        "no arm grasps from above all over any 0.04 m of the table, 0.45 m high", grasp_region, arms, far, zero
    )
    assert error.code is Code.UNREACHABLE
