# SPDX-License-Identifier: Apache-2.0
"""Pick and place with a scripted robot: what goes wrong with the arm and the hand, and how a request stops."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.sightings import standing_at
from openarm_grasp.requests.request import GraspRequest
from openarm_grasp.requests.states import State
from openarm_grasp.robot.interface import PlanGrasp, PlanPlace
from openarm_grasp.robot.skills import Skills
from openarm_grasp.strategies.pick_and_place import pick_and_place
from tests.openarm_grasp.scripted import Follow, GoHome, Grip, MoveLinear, frame_of


def oblong(label: str, x: float, y: float, edge: float = 0.06, height: float = 0.05) -> Detection:
    """A box on the table that is longer than wide."""
    return Detection(label, 0.9, se3.make(p=(x, y, 0.4 + 0.5 * height)), np.array([0.04, edge, height]))


# --- grasping
@pytest.mark.requirement("A-70")
def test_a_miss_opens_backs_off_and_tries_another_way(world):
    world.slips = 1
    assert world.succeeds().attempts == 2
    missed = world.log[world.log.index(next(x for x in world.log if world.grips(opening=False)(x[1]))) :]
    assert [type(e) for _, e in missed[3:7]] == [Grip, MoveLinear, GoHome, GoHome]  # pause, measure
    first, second = world.done(PlanGrasp)
    assert first.candidates[0].id not in {way.id for way in second.candidates}
    assert world.velocity_scale == 0.5, "and more slowly"


@pytest.mark.parametrize("sag", [0.012, 0.030])
def test_an_arm_that_gives_way_to_what_it_lifts_goes_on_and_one_that_is_blocked_does_not(world, sag):
    follow = world.follow

    async def heavy(arm, trajectory, what, **kwargs):
        await follow(arm, trajectory, what, **kwargs)
        if what == "lift":
            grasp = world.done(PlanGrasp)[-1].candidates[0]
            end = grasp.T_base_tcp.copy()
            end[:3, 3] += grasp.retreat_offset - (0.0, 0.0, sag)
            world.T_base_tcp = lambda arm: end
            raise OpenArmError(Code.EXECUTION_FAILED, f"the tool ended {sag * 1e3:.0f} mm from its goal; blocked?")

    world.follow = heavy
    outcome = world.grasp()
    assert outcome.success == (sag < 0.02), outcome.message
    assert outcome.code is (Code.OK if sag < 0.02 else Code.EXECUTION_FAILED)


@pytest.mark.requirement("A-71")
def test_without_an_object_the_grasp_fails(worlds, box):
    """The object disappears after its detection: three attempts at most, never a success."""
    world = worlds(box("red", 0.26, -0.2))
    world.faults.append(lambda e: world.objects.clear() if isinstance(e, PlanGrasp) else None)
    assert world.ends(Code.GRASP_MISSED, "nothing is in view").attempts == 1


def test_three_misses_end_with_a_named_refusal_open_hand_and_home(world):
    world.slips = 99
    assert world.ends(Code.GRASP_MISSED).attempts == 3
    assert world.gap == pytest.approx(0.088)
    moved = [call for _, call in world.log if isinstance(call, (Follow, GoHome, MoveLinear))]
    assert isinstance(moved[-1], GoHome)
    assert not world.session.kept


def test_where_an_object_is_that_was_moved_in_vain_is_said(world, box):
    world.slips = 99

    def roll(effect):
        if world.state is State.RESET and world.attempt == 3:
            world.objects.update(red=box("red", 0.34, -0.2))

    world.faults.append(roll)
    assert world.ends(Code.GRASP_MISSED).object_position[0] == pytest.approx(0.34)


def test_a_hand_that_stops_short_has_met_the_object(world):
    world.tcp_error = 0.02
    world.ends(Code.HAND_COLLISION, "20.0 mm")
    assert not world.times(world.grips(opening=False))


@pytest.mark.requirement("N-03", "A-70")
def test_an_object_that_moves_before_the_hand_goes_down_is_not_touched(world, box):
    moved = []

    def nudge(effect):
        if world.state is State.MOVE_TO_GRASP and not moved:
            moved.append(world.objects.update(red=box("red", 0.30, -0.2)))

    world.faults.append(nudge)
    assert world.succeeds().attempts == 2
    assert len(world.times(world.follows_path("approach"))) == 1  # the first hand did not go down
    assert world.done(PlanGrasp)[1].candidates[0].T_base_tcp[0, 3] == pytest.approx(0.30)


@pytest.mark.requirement("N-03")
def test_a_placed_object_that_the_detector_misses_is_looked_for_again(world):
    real, missed = world.frames, []

    def frames(count):
        if world.state is State.RESET and not missed:
            missed.append(count)
            world.pass_time(0.1 * count)
            return tuple(frame_of(t_ns=world.t_ns) for _ in range(count))
        return real(count)

    world.frames = frames
    assert (world.succeeds().attempts, missed) == (1, [3])


def test_an_alarm_that_the_look_from_home_does_not_confirm_is_raised_once(world, box):
    """From above the hand the object always seems to have moved; from home it stands where it stood."""
    real = world.frames
    shifted = box("red", 0.28, -0.2)

    def frames(count):
        found = real(count)
        if world.state is not State.MOVE_TO_GRASP:
            return found
        return tuple(frame_of(shifted, t_ns=frame.t_ns) for frame in found)

    world.frames = frames
    assert world.succeeds().attempts == 2


@pytest.mark.requirement("P-09")
def test_an_object_that_has_fallen_over_is_reported(world):
    """It stands at its target, lower than it was: nothing that the hand could try again would right it."""
    lies = {"size": np.array([0.05, 0.05, 0.04])}
    world.lands = lambda stands: replace(stands, T_base_object=se3.make(p=stands.p_base - (0.0, 0.0, 0.005)), **lies)
    assert world.ends(Code.PLACE_FAILED, "mm lower than it was").attempts == 1


@pytest.mark.requirement("P-09")
def test_what_fell_over_at_the_first_try_is_not_placed_by_putting_it_down_as_it_lies(worlds):
    stood = oblong("red", 0.26, -0.2, height=0.07)
    world = worlds(stood)

    def falls(stands):
        if world.attempt > 1:
            return stands
        T = se3.make(p=(stands.p_base[0], stands.p_base[1] + 0.1, 0.42))
        return replace(stands, T_base_object=T, size=np.array([0.07, 0.06, 0.04]))

    world.lands = falls
    assert world.ends(Code.PLACE_FAILED, "it was 30 mm lower than it was at first").attempts == 2


@pytest.mark.requirement("P-09")
@pytest.mark.parametrize(
    ("degrees", "edge", "placed"), [(0, 0.06, True), (9, 0.06, True), (25, 0.06, False), (25, 0.042, True)]
)
def test_a_yaw_that_was_asked_for_is_seen_unless_what_stands_there_looks_square(worlds, degrees, edge, placed):
    world = worlds(oblong("red", 0.26, -0.2, edge=edge))
    world.lands = lambda stands: standing_at(stands, stands.foot, np.radians(degrees))
    outcome = world.grasp(place=(0.2, -0.3, 0.4), place_yaw=0.3)
    assert outcome.success is placed, outcome.message
    assert placed or "it is turned 2" in outcome.message
    world = worlds(oblong("red", 0.26, -0.2, edge=edge))
    world.lands = lambda stands: standing_at(stands, stands.foot, np.radians(degrees))
    assert world.grasp(place=(0.2, -0.3, 0.4)).success  # any yaw will do


@pytest.mark.requirement("P-09")
def test_something_else_at_the_place_is_not_what_was_put_down(world):
    world.lands = lambda stands: replace(stands, name="green") if world.state is State.PLACE else stands
    outcome = world.grasp()
    assert outcome.code is Code.PLACE_FAILED
    assert "what is seen there is 'green', not 'red'" in outcome.message


@pytest.mark.requirement("N-03", "P-09")
@pytest.mark.parametrize("missed", [0, 1, 2])
def test_a_placed_object_that_the_detector_misses_in_one_frame_is_placed(world, missed):
    real = world.frames

    def frames(count):
        found = list(real(count))
        if world.state is State.RESET:
            found[missed] = frame_of(world.objects["blue"], t_ns=found[missed].t_ns)
        return tuple(found)

    world.frames = frames
    assert world.succeeds().attempts == 1


@pytest.mark.requirement("P-08", "P-09")
@pytest.mark.parametrize("phase", ["pick", "all"])
def test_a_camera_whose_place_is_not_known_says_nothing_and_nothing_is_said_to_be_done(world, phase):
    real = world.frames
    world.frames = lambda count: tuple(replace(one, cloud=None) for one in real(count))
    outcome = world.grasp(phase=phase)
    assert outcome.code is Code.STALE_DATA
    assert "nothing shows whether it has gone" in outcome.message or "no points of what stands" in outcome.message


@pytest.mark.requirement("P-08")
def test_held_but_still_seen_in_its_place_is_put_back(world):
    """The hand has something, but the camera says it is not the object: no success, and nothing is dropped."""
    world.lifted = lambda label: None
    world.ends(Code.GRASP_MISSED, "100% of it are still seen at its place")
    assert [e.what for e in world.done(MoveLinear)] == ["put back", "back off"] * 3


def test_lost_on_the_way_is_found_again(world, box):
    def drop_once(effect):
        if not world.follows_path("carry")(effect) or world.attempt > 1:
            return None
        world.objects["red"] = box("red", 0.3, -0.3)
        world.held, world.gap = None, 0.0
        return OpenArmError(Code.GRASP_LOST, "dropped by injection")

    world.faults.append(drop_once)
    assert world.succeeds().attempts == 2


# --- placing
@pytest.mark.requirement("P-09")
def test_a_place_that_is_not_seen_within_2_cm_is_tried_again(world):
    world.place_error = 0.03
    assert world.ends(Code.PLACE_FAILED, "30 mm from where it was put down").attempts == 3


def test_a_place_that_is_planned_in_vain_during_the_lift_is_planned_again_from_where_the_arm_is(world):
    world.fail(lambda e: isinstance(e, PlanPlace), Code.NO_PLAN, times=1)
    assert world.succeeds().attempts == 1
    first, second = world.done(PlanPlace)
    assert (str(first.after), second.after) == ("lift", None)


def test_a_place_that_cannot_be_planned_puts_the_object_back(world):
    world.fail(lambda e: isinstance(e, PlanPlace), Code.NO_PLAN, times=2)
    outcome = world.ends(Code.PLACE_FAILED)
    assert world.objects["red"].p_base[:2] == pytest.approx((0.26, -0.2))
    assert not world.session.kept
    assert outcome.place_position == (0.0, 0.0, 0.0)


def test_a_carry_that_was_blocked_puts_the_object_back_and_tries_again(world):
    world.fail(world.follows_path("carry"), Code.EXECUTION_FAILED, times=1)
    assert world.succeeds().attempts == 2
    first, _, second = world.done(PlanPlace)
    assert first.targets[0].position != pytest.approx(second.targets[0].position)


def test_a_hand_that_can_put_its_object_nowhere_keeps_it_and_says_so(world):
    world.fail(lambda e: isinstance(e, PlanPlace), Code.NO_PLAN)
    world.ends(Code.PLACE_FAILED, "still holds 'red'")
    assert world.held == "red"
    assert list(world.session.kept) == ["right"]


def test_what_hangs_around_the_hand_is_let_go_though_no_plan_knows_how_it_hangs(world):
    """As far as known the hand could not leave it: another thing may have come along."""
    world.fail(lambda e: isinstance(e, PlanPlace) and e.held, Code.IN_COLLISION)
    world.ends(Code.PLACE_FAILED)
    assert world.held is None
    assert not world.session.kept
    assert any("as what has turned in the hand" in status.reason for status in world.status)


def test_a_failed_way_back_after_release_still_ends_well(world):
    world.fail(world.follows_path("leave"), Code.EXECUTION_FAILED, times=1)
    world.succeeds()
    assert [e.what for e in world.done(MoveLinear)] == ["leave"]


def test_the_placed_object_is_kept_clear_of_on_the_way_home(world):
    world.grasp()
    home = world.done(GoHome)[-1]
    assert [b.id for b in home.obstacles] == ["detected/blue_0", "placed/red"]


@pytest.mark.parametrize("code", [Code.IN_COLLISION, Code.EXECUTION_FAILED])
def test_no_way_home_is_tried_without_obstacles_then_the_arm_stays_or_says_what_keeps_it(world, code):
    homes = iter([False, True, True])
    world.fail(lambda e: isinstance(e, GoHome) and e.arms == ("right",) and next(homes), code)
    outcome = world.grasp()
    assert outcome.code is (Code.OK if code is Code.IN_COLLISION else code), outcome.message
    assert outcome.success or "could not go home" in outcome.message
    assert [len(e.obstacles) for e in world.done(GoHome) if e.arms == ("right",)] == [0, 2, 0]


@pytest.mark.parametrize(("code", "goes_on"), [(Code.IN_COLLISION, True), (Code.ROBOT_LOST, False)])
def test_an_arm_that_finds_no_way_home_keeps_the_other_from_nothing(world, code, goes_on):
    world.fail(lambda e: isinstance(e, GoHome) and e.arms == ("left",), code)
    outcome = world.grasp()
    assert outcome.success is goes_on, outcome.message
    assert goes_on or outcome.code is code


# --- stopping
@pytest.mark.parametrize("code", [Code.CANCELLED, Code.ROBOT_LOST, Code.INTERNAL])
@pytest.mark.parametrize("state", [state for state in State if state not in (State.IDLE, State.TRANSFORM)])
def test_a_stop_in_any_state_ends_the_request_and_the_next_works(world, state, code):
    world.faults.append(lambda e: OpenArmError(code, "stopped by injection") if world.state is state else None)
    world.ends(code)
    assert world.states[-2:] == [state, State.IDLE]
    world.faults.clear()
    if world.held:
        world.move_gripper(0.044)
    assert world.grasp().success


@pytest.mark.requirement("P-21")
def test_a_cancel_while_carrying_keeps_the_object(world):
    world.fail(world.follows_path("carry"), Code.CANCELLED)
    world.ends(Code.CANCELLED)
    assert world.held == "red"
    assert list(world.session.kept) == ["right"]
    assert world.times(world.grips(opening=True)) == world.times(world.grips(opening=True))[:1]


def test_a_request_for_an_unknown_arm_is_refused_and_the_next_works(world):
    with pytest.raises(OpenArmError, match="auto, left, right"):
        pick_and_place(world.task(GraspRequest("red", arm="middle")), GraspRequest("red", arm="middle")).send(None)
    assert world.status == []
    assert world.grasp().success


def test_a_defect_of_the_program_is_answered_and_the_next_request_works(world):
    world.faults.append(lambda call: 1 / 0 if isinstance(call, PlanGrasp) else None)
    world.ends(Code.INTERNAL, "ZeroDivisionError")
    world.faults.clear()
    assert world.grasp().success


@pytest.mark.requirement("B-72")
def test_every_transition_has_a_reason_and_begins_where_the_last_ended(world):
    world.slips = 1
    world.grasp()
    assert all(status.reason for status in world.status)
    assert all(a.state is b.previous for a, b in pairwise(world.status))


@pytest.mark.parametrize("meets", [False, True])
def test_what_has_turned_in_the_hand_is_put_back_though_the_map_shows_it_there(world, meets):
    """It is no obstacle of the way back, and where it meets the table before the hand is down it is let go."""
    stood = world.objects["red"]

    def lifted(label):  # seen by the camera as it hangs: far below the hand
        world.objects[label] = replace(stood, T_base_object=se3.make(p=(0.0, 0.0, 0.04)) @ stood.T_base_object)

    world.lifted, follow = lifted, world.follow
    world.fail(lambda e: isinstance(e, MoveLinear) and e.what == "put back", Code.IN_COLLISION)

    async def back(arm, trajectory, what, **kwargs):
        await follow(arm, trajectory, what, **kwargs)
        if what == "put back":
            world.objects["red"] = stood
            if meets and str(trajectory) == "carry":
                raise OpenArmError(Code.EXECUTION_FAILED, "the tool ended 14 mm from its goal; blocked?")

    world.follow = back
    outcome = world.ends(Code.GRASP_LOST)
    assert outcome.attempts == 3
    assert not outcome.held
    back_there = [
        plan for plan in world.done(PlanPlace) if plan.after is None
    ]  # the others were planned during the lift
    assert len(back_there) == 3
    for plan in back_there:
        assert plan.held == ()
        assert len(plan.ignore_regions) == 2
        assert plan.targets[0].approach_offset[2] > 0.05


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize(("above", "let_go"), [(0.01, True), (0.05, False)])
def test_what_meets_something_just_above_its_place_is_let_go_there(world, above, let_go):
    def hand(arm):
        plans = world.done(PlanPlace)
        place = plans[-1].targets[0].T_base_tcp if plans else se3.make(p=(0.26, 0.2, 0.6))
        return se3.make(p=(0.0, 0.0, above)) @ place

    world.T_base_tcp = hand
    world.fail(world.follows_path("carry"), Code.EXECUTION_FAILED, times=1)
    assert world.succeeds().attempts == (1 if let_go else 2)


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize("times", [1, 2])
def test_what_a_hand_kept_and_meets_something_with_goes_to_another_place(world, times):
    assert world.grasp(phase="pick").success
    world.fail(world.follows_path("carry"), Code.EXECUTION_FAILED, times=times)
    outcome = world.grasp(phase="place")
    first, second = world.done(PlanPlace)[-2:]
    apart = first.targets[0].position - second.targets[0].position
    assert np.linalg.norm(apart[:2]) > 0.02
    assert outcome.success == (times == 1), outcome.message
    assert list(world.session.kept) == ([] if times == 1 else ["right"])


@pytest.mark.requirement("R-17")
def test_what_a_hand_kept_is_let_go_where_it_meets_something_and_taken_from_there(world):
    """It hangs lower than it should, and would block the hand for every order to come."""
    assert world.grasp(phase="pick").success
    assert list(world.session.kept) == ["right"]

    def hand(arm):
        plans = world.done(PlanPlace)
        return se3.make(p=(0.0, 0.0, 0.05)) @ (
            plans[-1].targets[0].T_base_tcp if plans else se3.make(p=(0.26, 0.2, 0.6))
        )

    world.T_base_tcp = hand
    world.fail(world.follows_path("carry"), Code.EXECUTION_FAILED, times=1)
    assert world.succeeds(phase="place").attempts == 2
    assert not world.session.kept
    assert any("50 mm above its place" in status.reason for status in world.status)


def test_what_a_hand_holds_and_meets_something_on_its_way_back_is_let_go_there(world):
    world.fail(lambda e: isinstance(e, PlanPlace), Code.NO_PLAN, times=1)
    world.lifted = lambda label: None  # it is still seen in its place
    world.fail(lambda e: isinstance(e, MoveLinear) and e.what == "put back", Code.EXECUTION_FAILED)
    assert not world.ends(Code.GRASP_MISSED).held
    assert world.held is None


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize("rises", [True, False])
def test_a_hand_with_no_way_home_rises_first(monkeypatch, rises):
    moves = []

    class Robot:
        def check(self):
            pass

        async def move(self, arm, to, what, obstacles=()):
            moves.append(what)
            if len(moves) == 1 or (len(moves) == 2 and not rises):
                raise OpenArmError(Code.NO_PLAN, what)

    skills = Skills.__new__(Skills)
    skills._config, skills.robot = GraspConfig(), Robot()
    monkeypatch.setattr(Skills, "T_base_tcp", lambda self, arm: np.eye(4))
    work = skills._home("left", ())
    with pytest.raises(StopIteration if rises else OpenArmError) as error:
        work.send(None)
    expected = ["left arm: go home", "left arm: rise", "left arm: go home"]
    assert moves == expected[: 3 if rises else 2]
    assert rises or error.value.message == "left arm: go home"
