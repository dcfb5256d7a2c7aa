# SPDX-License-Identifier: Apache-2.0
"""What the motion node is asked for."""

from __future__ import annotations

import numpy as np

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import pose_to_matrix
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import Box, held_boxes, propose, target_box
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace
from openarm_grasp.ros import messages


def test_a_plan_of_what_comes_later_names_where_the_object_will_not_stand_any_more() -> None:
    config = GraspConfig()
    target = Detection("red", 1.0, se3.make(p=(0.30, -0.20, 0.425)), np.full(3, 0.05))
    ways = propose(target, config, RobotDescription.load().hand("right").parts)
    box, gone = target_box(target, config), Box("red", se3.make(p=(0.40, -0.20, 0.425)), (0.06, 0.06, 0.05))
    grasp = messages.plan_goal(PlanGrasp("right", ways, (), (box,), (gone,)), 0.0)
    place = messages.plan_goal(
        PlanPlace("right", (), (), held_boxes(target, ways[0], config), ignore_regions=(gone,)), 0.0
    )
    for goal in (grasp, place):
        (region,) = goal.ignore_regions
        np.testing.assert_allclose(pose_to_matrix(region.pose), gone.T_frame_box)
        assert (region.size.x, region.size.y, region.size.z) == gone.size
    assert list(messages.plan_goal(PlanGrasp("right", ways, (), (box,)), 0.0).ignore_regions) == []
    assert (grasp.blend_approach, place.blend_approach) == (False, True)
