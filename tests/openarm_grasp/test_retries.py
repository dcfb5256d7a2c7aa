# SPDX-License-Identifier: Apache-2.0
"""A retry changes something: whatever is measured of the object's yaw meanwhile, no grasp that failed is repeated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.camera import heavier_end
from openarm_grasp.planning.candidates import propose
from openarm_grasp.planning.retries import FailedGrasp, among, centre_of_mass, proposed
from openarm_grasp.requests.states import State
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace
from openarm_grasp.strategies import run as run_module
from tests.openarm_grasp.scripted import World, standing

CONFIG = GraspConfig()
HAND = RobotDescription.load().hand("right").parts
HALF_TURN = se3.rot_z(np.pi)


@dataclass
class Tried:
    """A grasp of an attempt: the hand, where the object was measured then, and the arm."""

    T_base_tcp: np.ndarray
    p_object: np.ndarray
    arm: str


def apart(a: Tried, b: Tried) -> tuple[float, float]:
    """Turn between two hands, deg, modulo the gripper's half turn; distance relative to the object, mm."""
    R_a, R_b = a.T_base_tcp[:3, :3], b.T_base_tcp[:3, :3]
    turn = min(se3.angle_between(R_a, R_b), se3.angle_between(R_a, R_b @ HALF_TURN))
    moved = (a.T_base_tcp[:3, 3] - a.p_object) - (b.T_base_tcp[:3, 3] - b.p_object)
    return float(np.degrees(turn)), 1e3 * float(np.linalg.norm(moved))


def is_repeat(difference: tuple[float, float]) -> bool:
    return difference[0] < 10.0 and difference[1] < 5.0


def with_size(d: Detection, *size: float) -> Detection:
    return replace(d, size=np.array(size))


def attempts(world: World, looks: list[Detection], picks: list[int], codes: list[Code]) -> list[Tried]:
    """Ask for a cube whose grasps all fail; at each look it is measured so, and the planner chooses so."""
    tried: list[Tried] = []
    real = world.plan

    def look(status) -> None:
        if status.state is State.DETECT:
            world.objects["red"] = looks[min(status.attempt, len(looks)) - 1]

    async def plan(request: PlanGrasp | PlanPlace) -> Planned:
        found = await real(request)
        if isinstance(request, PlanGrasp):
            chosen = picks[len(tried) % len(picks)] % len(request.candidates)
            p_object = world.objects["red"].p_base.copy()
            tried.append(Tried(request.candidates[chosen].T_base_tcp, p_object, request.arm))
            return replace(found, chosen=chosen)
        return found

    def fail(call) -> OpenArmError | None:
        if world.state is State.CLOSE_GRIPPER:
            return OpenArmError(codes[(world.attempt - 1) % len(codes)], "by injection")
        return None

    world.on_report, world.plan = look, plan  # type: ignore[method-assign]
    world.faults.append(fail)
    assert not world.grasp().success
    return tried


def cube(yaw: float, quarters: int, x: float = 0.26, y: float = -0.2) -> Detection:
    d = standing("red", x, y)
    return replace(d, T_base_object=se3.make(se3.rot_z(yaw + quarters * np.pi / 2.0), d.p_base))


measured = st.tuples(st.floats(-0.10, 0.10), st.integers(0, 3), st.floats(-0.002, 0.002))
failures = st.sampled_from([Code.GRASP_MISSED, Code.HAND_COLLISION, Code.GRASP_LOST])


@settings(max_examples=5)
@given(
    yaw=st.floats(-np.pi, np.pi),
    looks=st.lists(measured, min_size=6, max_size=6),
    picks=st.lists(st.integers(0, 30), min_size=1, max_size=8),
    codes=st.lists(failures, min_size=1, max_size=4),
    y=st.sampled_from([-0.2, -0.05]),
)
@pytest.mark.requirement("N-05", "R-20")
def test_no_retry_repeats_a_failed_grasp_whatever_the_camera_measures(yaw, looks, picks, codes, y):
    """Axes swapped, yaw off by some degrees, position by 2 mm, and a planner that chooses any of what it is offered."""
    found = [cube(yaw + noise, quarters, 0.26 + off, y) for noise, quarters, off in looks]
    tried = attempts(World(found[0], limits={"max_attempts": 6}), found, picks, codes)
    assert len(tried) == 6
    assert [apart(a, b) for a, b in combinations(tried, 2) if is_repeat(apart(a, b))] == []


@pytest.mark.requirement("N-05")
def test_a_grasp_is_repeated_only_when_there_is_no_other_and_that_is_said():
    """One side fits into the hand, which may not lean, and the object is too flat for a higher grasp."""
    flat = with_size(standing("red", 0.26, -0.2, size=0.03), 0.04, 0.09, 0.03)
    world = World(flat, approach={"tilts_deg": [0.0]})
    assert len(attempts(world, [flat], [0], [Code.GRASP_MISSED])) == 3
    said = [status.reason for status in world.status if status.state is State.PLAN]
    assert ["all that is left has failed before" in reason for reason in said] == [False, True, True]


@pytest.mark.requirement("N-05")
def test_what_is_refused_elsewhere_is_asked_for_again_last():
    """The planner refuses all but one way: that one is tried again when it has refused all others on any line."""
    world = World(standing("red", 0.26, -0.2))
    real = world.plan
    asked: list[int] = []

    async def plan(request):
        if isinstance(request, PlanGrasp):
            asked.append(len(request.candidates))
            best = [way for way in request.candidates if way.id == "red/x+/tilt0"]
            if not best:
                raise OpenArmError(Code.UNREACHABLE, "right arm: too far")
            return replace(await real(request), chosen=request.candidates.index(best[0]))
        return await real(request)

    world.plan, world.slips = plan, 1
    assert world.succeeds().attempts == 2
    assert asked[0] == 28
    assert asked[1] == asked[2] > asked[3] > 0
    assert any("all that is left has failed before" in reason for reason in world.notes)


@pytest.mark.parametrize(
    ("code", "up"), [(Code.HAND_COLLISION, 0.010), (Code.GRASP_LOST, 0.0), (Code.GRASP_MISSED, 0.0)]
)
@pytest.mark.requirement("N-05")
def test_what_changes_first_follows_from_the_cause(code, up):
    """A hand that met something stays higher; fingers that lost or missed the object go to its other sides."""
    target = cube(0.3, 0)
    first = propose(target, CONFIG, HAND)[0]
    failed = FailedGrasp.of(code, "right", first, target)
    second = among(proposed(target, CONFIG, HAND, (failed,)), target, (failed,)).fresh[0]
    assert second.T_base_tcp[2, 3] - first.T_base_tcp[2, 3] == pytest.approx(up)
    assert second.T_base_tcp[:3, 1] @ first.T_base_tcp[:3, 1] == pytest.approx(0.0, abs=0.1)
    assert second.tilt == 0.0


@pytest.mark.requirement("N-05")
def test_an_arm_that_missed_leaves_the_next_attempt_to_the_other_where_both_reach():
    near, far = cube(0.3, 0, y=-0.05), cube(0.3, 0, y=-0.2)
    for target, arms in ((near, ["right", "left", "right"]), (far, ["right"] * 3)):
        assert [one.arm for one in attempts(World(target), [target], [0], [Code.GRASP_MISSED])] == arms
    lost = attempts(World(near), [near], [0], [Code.GRASP_LOST])
    assert [one.arm for one in lost] == ["right"] * 3


def test_what_turned_in_the_hand_is_held_nearer_to_its_weight_next():
    target = standing("red", 0.26, -0.2)
    T = [se3.make(se3.rot_x(np.pi), (x, -0.2, 0.43)) for x in (0.38, 0.30, 0.26)]
    levers = (-1.4, -0.9, -0.1)
    offered = [
        replace(
            propose(target, CONFIG, HAND)[0],
            id=f"red/{k}/tilt0",
            T_base_tcp=pose,
            score=1.0 - 0.4 * k,
            parts={"lever": lever},
        )
        for k, (pose, lever) in enumerate(zip(T, levers, strict=True))
    ]
    lost, missed = (FailedGrasp.of(c, "right", offered[0], target) for c in (Code.GRASP_LOST, Code.GRASP_MISSED))
    assert among(offered, target, (missed,)).fresh[0].id == "red/1/tilt0"
    assert among(offered, target, (lost,)).fresh[0].id == "red/2/tilt0"


def test_of_sampled_grasps_the_one_that_failed_comes_last_and_other_sides_first():
    target = standing("red", 0.26, -0.2)
    offered = propose(target, CONFIG, HAND)
    assert among(offered, target, ()).fresh == offered
    failed = FailedGrasp.of(Code.GRASP_MISSED, "right", offered[0], target)
    left = among(offered, target, (failed,))
    assert offered[0].id in {c.id for c in left.repeats}
    assert failed.sides(left.fresh[0]) < 0.1
    assert {c.id for c in (*left.fresh, *left.repeats)} == {c.id for c in offered}


def test_a_hand_that_met_something_on_a_cloud_goes_less_deep_next():
    target = standing("red", 0.26, -0.2)
    first = replace(propose(target, CONFIG, HAND)[0], apertures=(0.02, 0.06))
    heights = (0.0, 0.004, 0.012)
    offered = [
        replace(
            first,
            id=f"red/{k}/tilt0",
            T_base_tcp=se3.make(p=(0.03 * k, 0.0, up)) @ first.T_base_tcp,
            score=1.0 - 0.1 * k,
        )
        for k, up in enumerate(heights)
    ]
    for code, best in ((Code.EXECUTION_FAILED, "red/2/tilt0"), (Code.GRASP_MISSED, "red/1/tilt0")):
        failed = FailedGrasp.of(code, "right", offered[0], target)
        assert among(offered, target, (failed,)).fresh[0].id == best


def test_the_weight_is_sought_between_the_hand_and_the_end_that_hung_lower():
    target = standing("red", 0.30, -0.2)
    bar = np.column_stack([np.linspace(0.20, 0.40, 41), np.full(41, -0.2), np.full(41, target.bottom + 0.01)])
    ahead = np.array([1.0, 0.0])
    first = propose(target, CONFIG, HAND)[0]

    def turned(x: float, heavy: np.ndarray) -> FailedGrasp:
        held = replace(first, T_base_tcp=se3.make(first.T_base_tcp[:3, :3], (x, -0.2, 0.43)))
        return FailedGrasp.of(Code.GRASP_LOST, "right", held, target, heavy)

    def sought(*failed: FailedGrasp) -> float:
        return float(centre_of_mass(bar, target, failed)[0])

    assert sought() == pytest.approx(0.30)
    assert sought(turned(0.30, ahead)) == pytest.approx(0.35)
    assert sought(turned(0.30, ahead), turned(0.35, ahead)) == pytest.approx(0.375)
    assert sought(turned(0.30, ahead), turned(0.35, -ahead)) == pytest.approx(0.325)
    assert sought(turned(0.24, ahead)) == pytest.approx(0.30)  # it was held away from the middle: that explains it


@pytest.mark.parametrize("yaw", [0.0, 0.7, 2.0])
def test_a_turn_in_the_hand_shows_the_heavier_end(yaw):
    T_base_tcp = se3.make(se3.rot_z(yaw) @ se3.rot_x(np.pi), (0.3, -0.2, 0.5))
    along = np.linspace(-0.1, 0.1, 60)
    bar = se3.apply(T_base_tcp, np.column_stack([along, np.zeros(60), np.zeros(60)]))
    for turn in (0.6, -0.6):
        now = se3.apply(T_base_tcp @ se3.make(se3.rot_y(turn)), np.column_stack([along, np.zeros(60), np.zeros(60)]))
        heavy = heavier_end(bar, now, T_base_tcp)
        lowest = now[np.argmin(now[:, 2]), :2] - T_base_tcp[:2, 3]
        assert heavy is not None
        assert heavy @ lowest / np.linalg.norm(lowest) == pytest.approx(1.0)
    assert heavier_end(bar, bar, T_base_tcp) is None
    assert heavier_end(bar, bar[:3], T_base_tcp) is None


def test_a_grasp_near_the_weight_on_a_shorter_line_comes_before_one_far_from_it(monkeypatch):
    """The planner refuses what is near the weight on the usual line, and nothing else."""
    world = World(standing("red", 0.26, -0.2))
    one = propose(standing("red", 0.26, -0.2), CONFIG, HAND)[0]
    near, far = (replace(one, id=f"red/{k}/tilt0", parts={"lever": lever}) for k, lever in enumerate((-0.1, -1.5)))
    monkeypatch.setattr(run_module, "offers", lambda *_: (far, near))
    real = world.plan
    asked: list[tuple[str, ...]] = []

    async def plan(request):
        if isinstance(request, PlanGrasp):
            asked.append(tuple(way.id for way in request.candidates))
            if asked[-1] == (near.id,):
                raise OpenArmError(Code.UNREACHABLE, "right arm: too far")
        return await real(request)

    world.plan = plan
    outcome = world.succeeds()
    assert asked == [(near.id,), (f"{near.id}/short",)]
    assert {option.id for option in outcome.options} == {near.id, far.id, f"{near.id}/short"}  # all are shown
