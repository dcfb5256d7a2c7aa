# SPDX-License-Identifier: Apache-2.0
"""Choosing and planning approaches."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_motion.collision.exact import CollisionScene
from openarm_motion.collision.solids import Box, box_from
from openarm_motion.kinematics.line import Line
from openarm_motion.planning import approach as approach_module
from openarm_motion.planning import arm as arm_module
from openarm_motion.planning.alternative import explained_approach
from openarm_motion.planning.approach import ApproachFailedError, ApproachRequest, Target, plan_approach
from openarm_motion.planning.arm import Arm
from openarm_motion.planning.failure import PlanFailedError
from openarm_motion.planning.ompl_planner import OmplPlanner
from openarm_motion.planning.planner import PlannedPath, PlanQuery
from openarm_motion.timing.trajectory import Trajectory
from openarm_motion.timing.validation import keeps_clear, validate_trajectory
from tests.openarm_motion.conftest import shares_of_limits

TABLE_Z = 0.40
UP = np.array([0.0, 0.0, 0.12])


def grasp(name: str, x: float, y: float, height: float, yaw: float, tilt: float = 0.0, score: float = 1.0) -> Target:
    """Grasp from above, leaning by `tilt` across the opening axis, tips 12 mm over the table at least."""
    opening = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    z = np.array([0.0, 0.0, -np.cos(tilt)]) + np.sin(tilt) * np.cross([0.0, 0.0, 1.0], opening)
    tool = max(0.012 + 0.018 * np.sin(tilt), height / 2 - 0.017, height - 0.045 + 0.03 * np.sin(tilt))
    pose = se3.make(se3.rotation_from_z_y(z, opening), (x, y, TABLE_Z + tool))
    return Target(name, pose, -0.08 * z, UP, score)


def targets(x: float, y: float, height: float, yaw: float) -> tuple[Target, ...]:
    """24 targets: four tilts, both faces, both leans (the tool turned by half), two nudged."""
    found = []
    for tilt in (0.0, 15.0, 30.0, 45.0):
        for k in range(4):
            name = f"tilt{tilt:g}/{k}"
            found.append(grasp(name, x, y, height, yaw + k * np.pi / 2, np.radians(tilt), 1.0 - tilt / 90.0))
        for k in range(2):
            found.append(grasp(f"tilt{tilt:g}/high{k}", x, y, height + 0.01, yaw + k * np.pi, np.radians(tilt), 0.4))
    return tuple(found)


def cube(x: float, y: float, height: float = 0.05, yaw: float = 0.0, width: float = 0.05) -> Box:
    return box_from("cube", (x, y, TABLE_Z + height / 2), (width, width, height), se3.rot_z(yaw))


def assert_tool_straight(arm: Arm, q: np.ndarray, T_a: np.ndarray, T_b: np.ndarray) -> None:
    poses = arm.kinematics.fk_many(q)
    np.testing.assert_allclose(poses[0], T_a, atol=1e-6)
    np.testing.assert_allclose(poses[-1], T_b, atol=1e-6)
    d = (T_b - T_a)[:3, 3] / np.linalg.norm((T_b - T_a)[:3, 3])
    offset = poses[:, :3, 3] - T_a[:3, 3]
    assert np.abs(offset - np.outer(offset @ d, d)).max() < 1e-4


@pytest.mark.requirement("B-47")
def test_a_grasp_is_approached_and_lifted_on_straight_lines(arms: dict[str, Arm], home: dict[str, float]) -> None:
    arm, y = arms["left"], 0.22
    request = ApproachRequest(
        targets=targets(0.26, y, 0.05, 0.3),
        obstacles=(cube(0.26, y, 0.05, 0.3),),
        touchable=frozenset({"cube"}),
        attached_after=True,
    )
    plan = plan_approach(arm, arm.start_state(home), request)
    target = request.targets[plan.chosen]
    assert target.score == 1.0
    before, after = target.pose.copy(), target.pose.copy()
    before[:3, 3] += target.approach_offset
    after[:3, 3] += target.retreat_offset
    times = np.linspace(0.0, 10.0, 500)
    assert_tool_straight(arm, plan.approach.at(times)[0], before, target.pose)
    assert_tool_straight(arm, plan.retreat.at(times)[0], target.pose, after)
    np.testing.assert_allclose(plan.transfer.q[0], [home[name] for name in arm.names], atol=1e-9)
    np.testing.assert_allclose(plan.transfer.q[-1], plan.approach.q[0], atol=1e-9)
    np.testing.assert_allclose(plan.approach.q[-1], plan.retreat.q[0], atol=1e-9)
    assert arm.kinematics.margin(plan.approach.q[-1]) >= 0.05
    # one branch all the way
    branches = {arm.inverse.classify(q).branch for q in (*plan.approach.q, *plan.retreat.q)}
    assert len(branches) == 1
    # what is held afterwards is the cube, seen from the tool
    np.testing.assert_allclose(target.pose @ plan.held_after[0].T, request.obstacles[0].T, atol=1e-12)


def test_every_moment_of_a_plan_is_free_of_what_it_must_not_touch(right: Arm, home: dict[str, float]) -> None:
    obstacles = (cube(0.27, -0.2), box_from("can", (0.27, -0.34, TABLE_Z + 0.055), (0.066, 0.066, 0.11)))
    request = ApproachRequest(targets(0.27, -0.2, 0.05, 0.0), obstacles, (), frozenset({"cube"}), attached_after=True)
    plan = plan_approach(right, right.start_state(home), request)
    opened = right.with_gripper(home, 0.044)
    free = right.scene(opened, obstacles)
    for q in plan.transfer.at(np.linspace(0, plan.transfer.duration, 200))[0]:
        assert not free.collides(q)
    near = right.scene(opened, obstacles, touchable=frozenset({"cube"}), straight=True)
    for q in plan.approach.at(np.linspace(0, plan.approach.duration, 100))[0]:
        assert not near.collides(q)
    held = right.scene(right.with_gripper(home, 0.025), obstacles[1:], plan.held_after, straight=True)
    for q in plan.retreat.at(np.linspace(0, plan.retreat.duration, 100))[0]:
        assert not held.collides(q)


@pytest.mark.requirement("N-11")
def test_both_lines_carry_a_certificate_and_one_that_fails_it_is_not_handed_out(
    right: Arm, home: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    request = ApproachRequest(
        targets(0.26, -0.22, 0.05, 0.3),
        (cube(0.26, -0.22, 0.05, 0.3),),
        touchable=frozenset({"cube"}),
        attached_after=True,
    )
    validated: list[Trajectory] = []

    def validate(scene: CollisionScene, trajectory: Trajectory) -> None:
        validate_trajectory(scene, trajectory)
        validated.append(trajectory)

    def clear(scene: CollisionScene, trajectory: Trajectory) -> bool:
        validated.append(trajectory)
        return keeps_clear(scene, trajectory)

    with monkeypatch.context() as recorded:
        recorded.setattr(approach_module, "validate_trajectory", validate)
        recorded.setattr(arm_module, "validate_trajectory", validate)
        recorded.setattr(arm_module, "keeps_clear", clear)
        plan = plan_approach(right, right.start_state(home), request)
    assert {id(part) for part in plan.parts} <= {id(part) for part in validated}

    timed, dips = right.time_line, iter([True, False, False, True])

    def dipping(line: Line, scale: float) -> Trajectory:
        """Goes deeper between its ends than the line that was looked at; for two of the lines."""
        way = timed(line, scale)
        if not next(dips, False):
            return way
        low = right.kinematics.fk(way.at(way.duration / 2)[0][0])
        low[2, 3] -= 0.10
        below = right.inverse.nearest(low, way.at(way.duration / 2)[0][0], position_only=False).q
        u = np.sin(np.pi * way.t / way.duration)[:, None] ** 2
        return replace(way, q=(1.0 - u) * way.q + u * below)

    monkeypatch.setattr(right, "time_line", dipping)
    again = plan_approach(right, right.start_state(home), request)
    refused = [one for one in again.refusals if one.stage == "certificate"]
    assert len(refused) == 2
    assert all(one.code == Code.IN_COLLISION and one.contact for one in refused)
    assert "on the approach, after " in refused[0].message
    assert "on the retreat, after " in refused[1].message


def test_a_place_leaves_the_object_and_draws_back_with_open_fingers(right: Arm, home: dict[str, float]) -> None:
    state = right.with_gripper(home, 0.025)
    held = Box("cube", np.eye(4), np.array([0.05, 0.05, 0.05]))
    place = tuple(
        replace(
            t,
            pose=se3.make(t.pose[:3, :3], (0.24, -0.30, TABLE_Z + 0.026)),
            approach_offset=np.array([0, 0, 0.1]),
            retreat_offset=-0.08 * t.pose[:3, 2],
        )
        for t in targets(0.24, -0.30, 0.05, 0.0)[:4]
    )
    plan = plan_approach(right, right.start_state(state), ApproachRequest(place, (), (held,), detached_after=True))
    assert plan.held_after == ()
    standing = Box("cube", place[plan.chosen].pose, held.size)
    near = right.scene(right.with_gripper(home, 0.044), [standing], touchable=frozenset({"cube"}), straight=True)
    for q in plan.retreat.at(np.linspace(0, plan.retreat.duration, 100))[0]:
        assert not near.collides(q)
    carried = right.scene(state, (), (held,), straight=True)
    for q in plan.approach.at(np.linspace(0, plan.approach.duration, 100))[0]:
        assert not carried.collides(q)
    assert all(not right.scene(state, (), (held,)).collides(q) for q in plan.transfer.q)


def test_the_higher_score_is_chosen_where_it_can_be_reached(right: Arm, home: dict[str, float]) -> None:
    steep = grasp("steep", 0.26, -0.22, 0.05, 0.0, np.radians(30.0), score=0.9)
    upright = grasp("upright", 0.26, -0.22, 0.05, 0.0, 0.0, score=0.2)
    for order in ((steep, upright), (upright, steep)):
        plan = plan_approach(right, right.start_state(home), ApproachRequest(order))
        assert order[plan.chosen].id == "steep"
    wall = box_from("wall", (0.26, -0.05, TABLE_Z + 0.1), (0.3, 0.02, 0.2))
    leaning = grasp("leaning", 0.26, -0.12, 0.05, 0.0, np.radians(-45.0), score=0.9)
    straight = grasp("straight", 0.26, -0.20, 0.05, np.pi / 2, 0.0, score=0.1)
    plan = plan_approach(right, right.start_state(home), ApproachRequest((leaning, straight), (wall,)))
    if plan.chosen == 1:
        assert plan.refusals[0].id == "leaning"


def test_limit_margins_are_those_of_both_lines(right: Arm, home: dict[str, float]) -> None:
    ways = (grasp("far", 0.60, -0.22, 0.05, 0.0, score=0.9), grasp("near", 0.26, -0.22, 0.05, 0.0, score=0.5))
    worse = grasp("worse", 0.26, -0.22, 0.05, 1.0, score=0.1)
    plan = plan_approach(right, right.start_state(home), ApproachRequest((*ways, worse)))
    assert plan.chosen == 1
    refused, chosen, not_needed = plan.limit_margins
    assert np.isnan(refused)
    assert np.isnan(not_needed)
    lines = np.vstack([plan.approach.q, plan.retreat.q])
    assert chosen == pytest.approx(right.kinematics.margin(lines), abs=1e-3)


def test_refusals_say_why(right: Arm, home: dict[str, float]) -> None:
    far = grasp("far", 0.60, -0.22, 0.05, 0.0)
    buried = grasp("buried", 0.26, -0.22, 0.05, 0.0)
    buried.pose[2, 3] = TABLE_Z - 0.03
    with pytest.raises(ApproachFailedError) as caught:
        plan_approach(right, right.start_state(home), ApproachRequest((far, buried)))
    by_id = {refusal.id: refusal for refusal in caught.value.refusals}
    assert by_id["far"].code == Code.UNREACHABLE
    assert "mm short" in by_id["far"].message
    assert "nearest reachable pose" in by_id["far"].message
    assert by_id["buried"].code == Code.IN_COLLISION
    assert "table" in by_id["buried"].message
    assert caught.value.code == Code.IN_COLLISION
    assert caught.value.message.startswith("right arm: buried: ")
    assert "1 other targets refused" in caught.value.message
    assert caught.value.stage == "goal"
    assert caught.value.contact is not None
    assert caught.value.contact.second == "table"


def test_a_failed_approach_names_stage_pair_and_the_nearest_place_that_can_be_reached(
    right: Arm, home: dict[str, float]
) -> None:
    now = right.start_state(home)
    lid = box_from("lid", (0.26, -0.22, TABLE_Z + 0.07), (0.16, 0.16, 0.02))
    request = ApproachRequest((grasp("under", 0.26, -0.22, 0.05, 0.0),), (lid,))
    with pytest.raises(ApproachFailedError) as caught:
        explained_approach(lambda: plan_approach(right, now, request), right, now, request)
    error = caught.value
    assert (error.code, error.stage) == (Code.IN_COLLISION, "goal")
    assert error.contact is not None
    assert error.contact.second == "lid"
    found = error.alternative
    assert found is not None
    assert found.distance == pytest.approx(np.linalg.norm(found.pose[:3, 3] - request.targets[0].pose[:3, 3]))
    assert not right.scene(home, (lid,)).collides(found.q)
    assert 0.02 <= found.distance <= 0.25

    kerb = box_from("kerb", (0.26, -0.38, TABLE_Z + 0.03), (0.30, 0.02, 0.06))
    low = replace(grasp("low", 0.26, -0.22, 0.05, 0.0), retreat_offset=np.array([0.0, -0.15, 0.0]))
    with pytest.raises(ApproachFailedError) as caught:
        plan_approach(right, now, ApproachRequest((low,), (kerb,)))
    assert (caught.value.code, caught.value.stage) == (Code.IN_COLLISION, "line")
    assert "on the retreat" in caught.value.message


def test_an_object_in_the_way_refuses_only_the_targets_that_it_blocks(right: Arm, home: dict[str, float]) -> None:
    across = grasp("across", 0.27, -0.22, 0.06, 0.0)  # opens along x
    along = grasp("along", 0.27, -0.22, 0.06, np.pi / 2)  # opens along y
    neighbour = box_from("neighbour", (0.355, -0.22, TABLE_Z + 0.04), (0.05, 0.05, 0.08))
    request = ApproachRequest((across, along), (cube(0.27, -0.22, 0.06), neighbour), (), frozenset({"cube"}))
    plan = plan_approach(right, right.start_state(home), request)
    assert request.targets[plan.chosen].id == "along"
    assert plan.refusals[0].id == "across"
    assert "neighbour" in plan.refusals[0].message


@pytest.mark.long
def test_24_targets_are_planned_quickly(right: Arm, home: dict[str, float]) -> None:
    """To random objects, by the time of this thread."""
    rng = np.random.default_rng(24)
    took = []
    for _ in range(15):
        x, y, yaw = rng.uniform(0.18, 0.32), -rng.uniform(0.10, 0.38), rng.uniform(-np.pi, np.pi)
        request = ApproachRequest(
            targets(x, y, 0.05, yaw), (cube(x, y, 0.05, yaw),), (), frozenset({"cube"}), attached_after=True
        )
        assert len(request.targets) == 24
        begin = time.thread_time()
        plan_approach(right, right.start_state(home), request)
        took.append(time.thread_time() - begin)
    assert np.median(took) < 0.3


def test_where_the_best_targets_have_no_path_the_next_are_planned(right: Arm, home: dict[str, float]) -> None:
    class Choosy:
        """Finds nothing at first."""

        def __init__(self) -> None:
            self.limits: list[float] = []

        def plan(self, query: PlanQuery) -> PlannedPath:
            self.limits.append(query.time_limit)
            if len(self.limits) == 1:
                raise OpenArmError(Code.NO_PLAN, "no free path")
            return OmplPlanner().plan(query)

    planner = Choosy()
    arm = Arm("right", right.description, right.config, right.static, planner)
    best = grasp("best", 0.26, -0.22, 0.05, 0.0, score=1.0)
    next_best = grasp("next", 0.26, -0.22, 0.05, 0.0, np.radians(15.0), score=0.5)
    plan = plan_approach(arm, arm.start_state(home), ApproachRequest((next_best, best)))
    assert plan.chosen == 0
    assert [(r.id, r.code) for r in plan.refusals] == [("best", Code.NO_PLAN)]
    assert planner.limits[0] < 0.6 * arm.config.planning.time_limit  # time is left for the others


def test_progress_is_reported_and_a_plan_can_be_cancelled(right: Arm, home: dict[str, float]) -> None:
    reports: list[tuple[str, int]] = []
    request = ApproachRequest(targets(0.26, -0.22, 0.05, 0.0))
    plan_approach(right, right.start_state(home), request, lambda stage, tried: reports.append((stage, tried)))
    assert reports[0] == ("checking", 1)
    assert reports[-1][0] == "planning"
    with pytest.raises(OpenArmError) as caught:
        plan_approach(right, right.start_state(home, stopped=lambda: True), request)
    assert caught.value.code == Code.CANCELLED


def test_bad_requests_are_refused(right: Arm, home: dict[str, float]) -> None:
    now = right.start_state(home)
    good = grasp("g", 0.26, -0.22, 0.05, 0.0)
    with pytest.raises(OpenArmError, match="no targets"):
        plan_approach(right, now, ApproachRequest(()))
    with pytest.raises(OpenArmError, match="touchable cup not among the obstacles: cube"):
        plan_approach(right, now, ApproachRequest((good,), (cube(0.3, -0.2),), (), frozenset({"cup"})))
    with pytest.raises(OpenArmError, match="exclude each other"):
        plan_approach(right, now, ApproachRequest((good,), attached_after=True, detached_after=True))
    with pytest.raises(OpenArmError, match="target 'g' has numbers that are not finite"):
        plan_approach(right, now, ApproachRequest((replace(good, score=float("nan")),)))


def place(x: float, y: float, *others: Box, blend: bool = True) -> ApproachRequest:
    """A cube in the hand, and three ways to put it down."""
    held = box_from("cube", (0.0, 0.0, -0.012), (0.05, 0.05, 0.05))
    ways = tuple(
        replace(grasp(f"spot/{k}", x, y, 0.06, k * np.pi / 2), approach_offset=0.08 * UP / 0.12) for k in range(3)
    )
    return ApproachRequest(ways, others, (held,), detached_after=True, blend=blend)


@pytest.mark.parametrize("scale", [0.05, 1.0])
@pytest.mark.parametrize(("side", "x", "y"), [("left", 0.30, 0.30), ("right", 0.22, -0.12), ("right", 0.33, -0.28)])
def test_a_place_is_reached_without_a_stop_before_the_line_and_within_all_limits(
    arms: dict[str, Arm], home: dict[str, float], side: str, x: float, y: float, scale: float
) -> None:
    arm = arms[side]
    now = arm.start_state(home, scale=scale)
    stops, plan = (plan_approach(arm, now, place(x, y, blend=blend)) for blend in (False, True))
    assert plan.chosen == stops.chosen
    whole, T = plan.transfer, place(x, y).targets[plan.chosen].pose
    assert whole.duration < stops.transfer.duration + stops.approach.duration - 0.05
    assert max(shares_of_limits(whole, arm.limits(scale))) <= 1.0 + 1e-6
    np.testing.assert_allclose(whole.q[-1], stops.approach.q[-1], atol=1e-9)
    np.testing.assert_allclose(plan.approach.q, whole.q[[-1, -1]])
    np.testing.assert_allclose(plan.retreat.q[0], whole.q[-1], atol=1e-9)

    q, v, _ = whole.at(np.arange(0.0, whole.duration, 0.002))
    poses = arm.kinematics.fk_many(q)
    above = poses[:, 2, 3] - T[2, 3]
    low = np.flatnonzero(above < 0.05)
    assert np.abs(poses[low, :2, 3] - T[:2, 3]).max() < 0.001, "off the straight line near the place, m"
    assert max(se3.angle_between(pose[:3, :3], T[:3, :3]) for pose in poses[low]) < 0.01
    moving = np.abs(v[50:-50]).max(axis=1) / scale
    assert moving[int(np.argmin(np.abs(above[50:-50] - 0.08)))] > 0.05, "it does not stop where the line begins"
    speed = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) / 0.002
    assert speed[low[low < len(speed)]].max() <= arm.config.limits.straight_speed * scale * 1.01


@pytest.mark.parametrize("timing", ["stops", "quintic"])
def test_a_place_is_reached_with_a_stop_where_free_paths_have_stops(
    right: Arm, home: dict[str, float], monkeypatch: pytest.MonkeyPatch, timing: str
) -> None:
    config = right.config.model_copy(update={"planning": right.config.planning.model_copy(update={"timing": timing})})
    monkeypatch.setattr(right, "config", config)
    now = right.start_state(home)
    stops, plan = (plan_approach(right, now, place(0.30, -0.25, blend=blend)) for blend in (False, True))
    assert plan.transfer.duration == pytest.approx(stops.transfer.duration + stops.approach.duration)
    np.testing.assert_allclose(plan.transfer.at(stops.transfer.duration)[1], 0.0, atol=1e-9)


def test_the_corner_before_a_place_keeps_clear_of_what_stands_around_it(right: Arm, home: dict[str, float]) -> None:
    now, rng, gains = right.start_state(home), np.random.default_rng(7), list[float]()
    for _ in range(16):
        angle, off, height = rng.uniform((0.0, 0.09, 0.05), (2.0 * np.pi, 0.13, 0.30))
        x, y = 0.28 + off * np.cos(angle), -0.25 + off * np.sin(angle)
        request = place(0.28, -0.25, box_from("post", (x, y, TABLE_Z + height / 2), (0.02, 0.02, height)))
        try:
            stops = plan_approach(right, now, replace(request, blend=False))
        except ApproachFailedError:
            continue
        plan = plan_approach(right, now, request)
        gains.append(stops.transfer.duration + stops.approach.duration - plan.transfer.duration)
        scene = right.scene(home, request.obstacles, request.attached, straight=True)
        validate_trajectory(scene, plan.transfer, travel=0.002)
    assert len(gains) >= 8
    assert min(gains) >= 0.0
    assert max(gains) > 0.1


@pytest.mark.parametrize("length", [0.0, 1e-7, 0.004, 0.02])
def test_a_line_of_any_length_is_blended(right: Arm, home: dict[str, float], length: float) -> None:
    request = place(0.28, -0.25)
    ways = tuple(replace(way, approach_offset=np.array([0.0, 0.0, length])) for way in request.targets)
    plan = plan_approach(right, right.start_state(home), replace(request, targets=ways, attached=()))
    np.testing.assert_allclose(
        right.kinematics.fk(plan.transfer.q[-1])[:3, 3], ways[plan.chosen].pose[:3, 3], atol=1e-5
    )
    assert max(shares_of_limits(plan.transfer, right.limits(0.0))) <= 1.0 + 1e-6
    there = right.start_state({**home, **dict(zip(right.names, plan.transfer.q[-1].tolist(), strict=True))})
    again = plan_approach(right, there, replace(request, targets=ways, attached=()))
    assert again.transfer.duration < 1.0


def test_a_corner_that_cannot_be_rounded_has_a_stop(
    right: Arm, home: dict[str, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(scene: CollisionScene, trajectory: Trajectory) -> None:
        if np.any(trajectory.v[[0, -1]]):  # a part of a whole
            raise PlanFailedError(Code.IN_COLLISION, "it touches", "certificate", at=float(trajectory.t[-1]))

    now = right.start_state(home)
    stops = plan_approach(right, now, place(0.28, -0.25, blend=False))
    monkeypatch.setattr(approach_module, "validate_trajectory", refuse)
    plan = plan_approach(right, now, place(0.28, -0.25))
    assert plan.transfer.duration == pytest.approx(stops.transfer.duration + stops.approach.duration)
