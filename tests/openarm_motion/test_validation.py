# SPDX-License-Identifier: Apache-2.0
"""Validation of a timed trajectory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.errors import Code
from openarm_motion.collision.solids import box_from
from openarm_motion.planning.arm import Arm, StartState
from openarm_motion.planning.dual_arm import DualArm, DualArmScene
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.planner import PlannedPath, PlanQuery
from openarm_motion.timing.validation import dense_times, validate_trajectory
from tests.refusals import refuses


def across(right: Arm, home: dict[str, float]) -> PlannedPath:
    """The hand goes from one side to the other, 0.62 m high."""
    scene = right.scene(home)
    poses = [se3.make(se3.rotation_from_z_y((0, 0, -1), (0, 1, 0)), (0.32, y, 0.62)) for y in (-0.32, -0.10)]
    ends = [next(s.q for s in right.inverse.solutions(p, 0.05) if not scene.collides(s.q)) for p in poses]
    return PlannedPath(np.array(ends), 0, 1)


@pytest.mark.parametrize("sides", [("right",), ("left", "right")])
@pytest.mark.requirement("A-68")
def test_a_validation_finds_what_a_check_of_every_state_finds_with_far_fewer_checks(
    arms: dict[str, Arm], home: dict[str, float], monkeypatch: pytest.MonkeyPatch, sides: tuple[str, ...]
) -> None:
    group = arms["right"] if len(sides) == 1 else DualArm(arms["left"], arms["right"])
    rng, looks, every, free = np.random.default_rng(17), 0, 0, []
    for _ in range(6):
        boxes = [box_from(f"box{k}", rng.uniform((0.2, -0.5, 0.4), (0.6, 0.5, 0.9)), (0.1, 0.1, 0.1)) for k in range(4)]
        scene = group.scene(home, boxes)
        collides = scene.collides
        drawn = (q for q in rng.uniform(group.lower, group.upper, (400, len(group.names))) if not collides(q))
        ends = [next(drawn) for _ in range(3)]
        ends[2] = ends[1] + 0.15 * (ends[2] - ends[1])  # one far way and a short one, with a corner
        trajectory = group.timing(PlannedPath(np.array(ends), 0, 1), 0.5).trajectory()
        times = dense_times(trajectory, scene.levers)
        states = trajectory.at(times)[0]
        assert (np.abs(np.diff(states, axis=0)) @ scene.levers).max() <= 0.0045
        with scene.lenient(0.5, 0.9):
            free.append(not any(collides(q) for q in states))
        seen: list[np.ndarray] = []
        with monkeypatch.context() as counted:
            counted.setattr(scene, "collides", lambda q, ask=collides, seen=seen: seen.append(q) or ask(q))
            try:
                validate_trajectory(scene, trajectory)
                found = True
                looks, every = looks + len(seen), every + len(states)
            except PlanFailedError as error:
                found = False
                at = trajectory.at(error.at)[0][0]
                with scene.lenient(0.5, 0.9):
                    assert collides(at)
        assert found == free[-1]
    assert any(free)
    assert not all(free)
    assert looks < 0.5 * every


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_pairs_come_nearer_by_no_more_than_their_swings(
    arms: dict[str, Arm], home: dict[str, float], seed: int
) -> None:
    """Of both arms with something in each hand: distances before and after any turn of the joints."""
    rng = np.random.default_rng(seed)
    both = DualArm(arms["left"], arms["right"])
    held = [box_from(f"held{k}", (0.0, 0.0, 0.05), (0.05, 0.2, 0.05)) for k in range(2)]
    scene = both.scene(home, [box_from("box", (0.4, 0.0, 0.6), (0.1, 0.1, 0.1))], held=(held[:1], held[1:]))
    before = rng.uniform(both.lower, both.upper)
    after = np.clip(before + rng.normal(size=before.size) * 10.0 ** rng.uniform(-2.0, 0.0), both.lower, both.upper)
    apart = np.array([_distances(scene, q) for q in (before, after)])
    near = apart.max(axis=0) < 1.0  # further ones are not measured
    assert near.sum() > 100
    assert np.all((apart[0] - apart[1] <= scene.swings() @ np.abs(after - before) + 1e-5)[near])


def _distances(scene: DualArmScene, q: np.ndarray) -> list[float]:
    """Of all pairs of both scenes."""
    scene.contacts(q)
    return [part._contact(k).distance for part in scene.placed(q) for k in range(part.pairs)]


def test_a_trajectory_through_a_thin_sheet_is_refused_with_the_time_and_the_pair(
    right: Arm, home: dict[str, float]
) -> None:
    trajectory = right.timing(across(right, home), 0.5).trajectory()
    sheet = box_from("sheet", (0.32, -0.21, 0.6), (0.5, 0.001, 0.4))
    with refuses(Code.IN_COLLISION, r"after \d\.\d\d s of the trajectory openarm_right_.* sheet"):
        validate_trajectory(right.scene(home, [sheet]), trajectory)


def test_the_scene_asks_for_its_full_clearance_again_afterwards(right: Arm, home: dict[str, float]) -> None:
    path = across(right, home)
    p = right.kinematics.fk(path.waypoints[0])[:3, 3]
    sides = [(p[0], p[1], p[2] - 0.05 - gap) for gap in np.linspace(-0.04, 0.03, 71)]
    near = (right.scene(home, [box_from("block", c, (0.3, 0.3, 0.05))]) for c in sides)
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
    with refuses(Code.IN_COLLISION, "failed the validation"):
        arm.plan_validated(arm.scene(home, [sheet]), now, path.waypoints[1:], 1.0)
    assert planner.resolutions == [(0.05, 0.02), (0.0125, 0.005)]
