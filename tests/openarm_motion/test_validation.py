# SPDX-License-Identifier: Apache-2.0
"""Validation of a timed trajectory."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.solids import box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.planner import PlannedPath, PlanQuery
from openarm_motion.timing.validation import validate_trajectory


def across(right: Arm, home: dict[str, float]) -> PlannedPath:
    """The hand goes from one side to the other, 0.62 m high."""
    scene = right.scene(home)
    poses = [se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.32, y, 0.62)) for y in (-0.32, -0.10)]
    ends = [next(s.q for s in right.inverse.solutions(p, 0.05) if not scene.collides(s.q)) for p in poses]
    return PlannedPath(np.array(ends), 0, 1)


@pytest.mark.requirement("A-68")
def test_a_planned_trajectory_is_certified_with_no_point_moving_far_between_two_looks(
    right: Arm, home: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = right.scene(home)
    path = across(right, home)
    planned = right.plan(scene, StartState(home, path.waypoints[0]), path.waypoints[1:], 5.0)
    looks: list[np.ndarray] = []
    collides = scene.collides
    monkeypatch.setattr(scene, "collides", lambda q: looks.append(q) or collides(q))
    validate_trajectory(scene, [*right.timings(planned, 0.5)][-1])
    way = float(np.sum(np.abs(np.diff(planned.waypoints, axis=0)) @ scene.levers))
    assert len(looks) >= way / 0.004


def test_a_trajectory_through_a_thin_sheet_is_refused_with_the_time_and_the_pair(
    right: Arm, home: dict[str, float]
) -> None:
    trajectory = [*right.timings(across(right, home), 0.5)][-1]
    sheet = box_from("sheet", (0.32, -0.21, 0.6), (0.5, 0.001, 0.4))
    with pytest.raises(OpenArmError, match=r"after \d\.\d\d s of the trajectory openarm_right_.* sheet") as caught:
        validate_trajectory(right.scene(home, [sheet]), trajectory)
    assert caught.value.code == Code.IN_COLLISION


def test_the_scene_asks_for_its_full_clearance_again_afterwards(right: Arm, home: dict[str, float]) -> None:
    path = across(right, home)
    p = right.kinematics.fk(path.waypoints[0])[:3, 3]
    sides = [(p[0], p[1], p[2] - 0.05 - gap) for gap in np.linspace(-0.04, 0.03, 71)]
    near = [right.scene(home, [box_from("block", c, (0.3, 0.3, 0.05))]) for c in sides]
    scene = next(s for s in near if s.collides(path.waypoints[0]) and s.contacts(path.waypoints[0])[0].distance > 0.006)
    with scene.lenient(0.5):
        assert not scene.collides(path.waypoints[0])
    assert scene.collides(path.waypoints[0])


class Blind:
    """A planner that checks nothing, and records the resolution it was asked for."""

    def __init__(self) -> None:
        self.resolutions: list[tuple[float, float]] = []

    def plan(self, query: PlanQuery) -> PlannedPath:
        self.resolutions.append(query.resolution)
        return PlannedPath(np.stack([query.start, query.goals[0]]), 0, 0)


@pytest.mark.requirement("A-68")
def test_what_a_search_stepped_over_is_searched_again_more_closely_and_never_handed_out(
    right: Arm, home: dict[str, float]
) -> None:
    planner = Blind()
    arm = Arm("right", right.description, right.config, right.static, planner)
    path = across(right, home)
    sheet = box_from("sheet", (0.32, -0.21, 0.6), (0.5, 0.001, 0.4))
    now = StartState(home, path.waypoints[0])
    with pytest.raises(OpenArmError, match="failed the validation") as caught:
        arm.plan_validated(arm.scene(home, [sheet]), now, path.waypoints[1:], 1.0)
    assert caught.value.code == Code.IN_COLLISION
    assert planner.resolutions == [(0.05, 0.02), (0.0125, 0.005)]
