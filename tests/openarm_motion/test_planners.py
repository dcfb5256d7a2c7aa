# SPDX-License-Identifier: Apache-2.0
"""Another planner behind the same calls, by configuration alone."""

from __future__ import annotations

import sys
import types

import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.config import MotionConfig, PlanningConfig
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.moves import RequestBoxes, to_joints
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlannedPath, PlanQuery, make_planner
from openarm_motion.planning.rrt import FastPlanner
from tests.refusals import refuses


class Foreign:
    """As an adapter of another system would be: it has its own way of finding paths."""

    asked: list[PlanQuery]

    def plan(self, query: PlanQuery) -> PlannedPath:
        """By way of OMPL."""
        Foreign.asked.append(query)
        return OmplPlanner().plan(query)


class Careless:
    """Answers the straight line, whatever is in its way."""

    def plan(self, query: PlanQuery) -> PlannedPath:
        """A straight line."""
        return PlannedPath(np.stack([query.start, query.goals[0]]), 0, 0)


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> str:
    """Name of a module with both planners."""
    Foreign.asked = []
    module = types.ModuleType("another_system")
    module.Foreign, module.Careless, module.Nothing = Foreign, Careless, object  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "another_system", module)
    return "another_system"


def arm_with(planner: str, description: RobotDescription, table: Box) -> Arm:
    return Arm("right", description, MotionConfig(planning=PlanningConfig(planner=planner)), [table])


@pytest.mark.requirement("A-76", "B-39", "B-41")
def test_another_planner_gets_the_same_calls_and_its_path_is_timed(
    elsewhere: str, description: RobotDescription, table: Box, home: dict[str, float]
) -> None:
    arm = arm_with(f"{elsewhere}:Foreign", description, table)
    start = np.array([home[name] for name in arm.names])
    goal = start + np.array([0.0, 0.0, 0.3, 0.0, 0.2, 0.0, 0.1])
    trajectory = to_joints(arm, StartState(home, start), goal.tolist(), RequestBoxes())
    np.testing.assert_allclose(trajectory.q[-1], goal, atol=1e-9)
    (query,) = Foreign.asked
    assert 0.1 < query.time_limit <= 5.0
    assert not query.collides(goal)


@pytest.mark.requirement("A-76")
def test_a_path_of_another_planner_that_is_not_free_is_refused(
    elsewhere: str, description: RobotDescription, table: Box, home: dict[str, float]
) -> None:
    arm = arm_with(f"{elsewhere}:Careless", description, table)
    start = np.array([home[name] for name in arm.names])
    goal = start.copy()
    goal[0] += 1.2
    middle = arm.kinematics.fk(0.5 * (start + goal))[:3, 3]
    wall = box_from("wall", middle, (0.04, 0.04, 0.04))
    with refuses(Code.IN_COLLISION, "wall"):
        to_joints(arm, StartState(home, start), goal.tolist(), RequestBoxes([wall]))


def test_planners_by_name(elsewhere: str) -> None:
    assert isinstance(make_planner("fast"), FastPlanner)
    assert isinstance(make_planner("ompl"), OmplPlanner)
    for name, why in (
        ("nowhere.at_all:X", "No module named 'nowhere'"),
        (f"{elsewhere}:Missing", "Missing"),
        (f"{elsewhere}:Nothing", "has no method plan"),
    ):
        with refuses(Code.CONFIG_INVALID, why):
            make_planner(name)
    with pytest.raises(ValueError, match="planner"):
        PlanningConfig(planner="rrt star")
