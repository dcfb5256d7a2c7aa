# SPDX-License-Identifier: Apache-2.0
"""What the motion node is asked for."""

from __future__ import annotations

import numpy as np
import pytest
from openarm_interfaces.action import Pick, PlanApproach
from openarm_interfaces.msg import Refusal

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.robot.description import RobotDescription
from openarm_common.ros.convert import pose_to_matrix
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import Box, held_boxes, propose, target_box
from openarm_grasp.planning.options import NoWayError
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace
from openarm_grasp.ros import messages
from tests.refusals import refused


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


def test_a_refusal_names_the_bodies_that_would_meet() -> None:
    refusal = Refusal(id="a", code="IN_COLLISION", message="a: b would hit c", first="b", second="c")
    with pytest.raises(NoWayError) as error:
        messages.planned_from_msg(PlanApproach.Result(code="IN_COLLISION", refusals=[refusal]), 1)
    assert error.value.refusals["a"].bodies == ("b", "c")


def test_a_request_is_read_as_it_was_written() -> None:
    asked = GraspRequest(
        "red",
        "left",
        (0.3, 0.2, 0.0),
        phase="pick",
        place_yaw=0.5,
        timeout=3.0,
        velocity_scale=0.5,
        object_at=(0.25, 0.1),
        exclude_near=((0.1, 0.2),),
        place_choices=((0.3, 0.1),),
        place_on="tray",
        selection="largest",
    )
    goal = Pick.Goal()
    messages.fill_request(goal, asked)
    assert messages.request_from_msg(goal) == asked
    assert messages.request_from_msg(Pick.Goal(label="easiest can on:tray")) == GraspRequest(
        "can", selection="easiest", place_on="tray"
    )
    assert refused("must be x, y or x, y, z", messages.fill_request, goal, GraspRequest("red", place=(0.3,)))
