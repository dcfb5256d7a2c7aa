# SPDX-License-Identifier: Apache-2.0
"""Lines of a closed hand through what stands close together."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.context import GraspContext
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.neighbours import crowded
from openarm_grasp.planning.pushes import closed_hand, push_ways, sweeps
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace
from tests.openarm_grasp.scripted import HAND, Follow, World, robot_work, standing

CONFIG = GraspConfig()
LENGTHS = CONFIG.push.lengths
CONTEXT = GraspContext(CONFIG, robot_work().table, HAND, {"left": (0.0, 0.15), "right": (0.0, -0.15)})


def hand() -> np.ndarray:
    return closed_hand(RobotDescription.load(), "right")


def crowd(target: Detection, *others: Detection) -> Sighting:
    return Sighting(target, others, 0)


def ahead(sweep) -> np.ndarray:
    way = sweep.end - sweep.met.p_base[:2]
    return way / np.linalg.norm(way)


ROW = crowd(standing("red", 0.26, 0.2), standing("blue", 0.26, 0.255), standing("green", 0.26, 0.145))


@pytest.mark.requirement("R-17")
def test_out_of_a_row_an_object_is_pushed_across_it():
    first, *others = sweeps(ROW, hand(), CONTEXT, LENGTHS)
    assert abs(ahead(first)[0]) == pytest.approx(1.0, abs=1e-6)
    assert first.rest == ROW.others
    assert np.linalg.norm(first.freed - ROW.target.p_base[:2]) == pytest.approx(LENGTHS[1])  # clear of them
    along = [one for one in others if abs(ahead(one)[1]) > 0.99]  # with what is ahead, or comes before it
    assert all(len(one.rest) < 2 for one in along)


def test_a_line_begins_behind_all_that_the_hand_has_no_room_beside():
    along = next(one for one in sweeps(ROW, hand(), CONTEXT, LENGTHS) if ahead(one)[1] > 0.99)
    begin = along.met.p_base[1] - 0.5 * along.met.size[0]
    assert begin == pytest.approx(0.12, abs=0.01)  # the far side of the first of the row
    assert along.rest == ()
    ways = push_ways(along.met, along.end, CONFIG, hand(), HAND)
    assert ways
    for way in ways:
        assert way.T_base_tcp[1, 3] < begin


def test_boxes_about_what_is_moved_stand_clear_of_the_table_and_hold_all_of_it():
    for sweep in sweeps(ROW, hand(), CONTEXT, LENGTHS):
        moved = [one for one in (ROW.target, *ROW.others) if one not in sweep.rest]
        for box in sweep.heap:
            assert box.T_frame_box[2, 3] - 0.5 * box.size[2] >= CONTEXT.table.top_z + 0.5 * CONFIG.approach.table_gap
        for one in moved:
            local = (se3.apply(se3.inverse(box.T_frame_box), one.p_base[None])[0] for box in sweep.heap)
            assert any((np.abs(p) <= 0.5 * box.size).all() for p, box in zip(local, sweep.heap, strict=True))


def test_nothing_is_pushed_off_the_table_or_away_from_the_arms():
    x, y = CONTEXT.table.x[0] + 0.03, 0.2
    edge = crowd(standing("red", x, y), standing("blue", x, y + 0.055))
    assert all(ahead(one)[0] > -1e-6 for one in sweeps(edge, hand(), CONTEXT, LENGTHS))
    far = CONTEXT.config.place.region_x[1] + 0.05
    beyond = crowd(standing("red", far, y), standing("blue", far, y + 0.055))
    assert sweeps(beyond, hand(), CONTEXT, LENGTHS)
    assert all(ahead(one)[0] < -0.5 + 1e-6 for one in sweeps(beyond, hand(), CONTEXT, LENGTHS))


def test_a_crowd_is_what_stands_within_a_finger():
    assert crowded(ROW)
    assert not crowded(crowd(standing("red", 0.26, 0.2), standing("blue", 0.26, 0.31)))


def without_room(two: World) -> World:
    """A robot that has no room around what it is asked for until it has pushed."""
    plan = two.plan

    async def noted(request: PlanGrasp | PlanPlace) -> Planned:
        if isinstance(request, PlanGrasp) and not two.pushed and "/push/" not in request.candidates[0].id:
            raise OpenArmError(Code.IN_COLLISION, f"{request.arm} arm: the hand would hit detected/blue")
        return await plan(request)

    two.plan = noted
    return two


@pytest.fixture
def pressed(robot) -> World:
    two = without_room(robot(0.26, 0.2))
    two.objects["blue"] = standing("blue", 0.26, 0.255)
    two.objects["green"] = standing("green", 0.26, 0.145)
    return two


@pytest.mark.requirement("R-17")
def test_what_has_no_room_is_pushed_out_of_its_crowd_and_picked(pressed) -> None:
    # no push is known to help: around the crowd there is no place where it could be grasped
    pressed.objects |= {
        f"wall{k}": standing(f"wall{k}", 0.26 + 0.13 * np.cos(k), 0.2 + 0.13 * np.sin(k)) for k in range(7)
    }
    outcome = pressed.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "push"), outcome.message
    assert pressed.pushed == 1
    assert "through what is near it" in " ".join(pressed.notes)


@pytest.mark.requirement("R-17")
def test_the_easiest_object_is_not_pushed_for(pressed) -> None:
    outcome = pressed.ask("red", selection="easiest")
    assert (outcome.kind, outcome.code) == ("REFUSED", Code.IN_COLLISION)
    assert not pressed.done(Follow)


def test_a_push_that_is_blocked_is_observed_all_the_same(robot) -> None:
    two = robot(0.46, 0.02, far=0.44)
    follow = two.follow

    async def blocked(arm: str, trajectory: object, what: str, **kwargs) -> None:
        await follow(arm, trajectory, what, **kwargs)
        if what == "push":
            raise OpenArmError(Code.EXECUTION_FAILED, "the tool ended 11 mm from its goal")

    two.follow = blocked
    outcome = two.ask()
    assert (outcome.code, outcome.route) == (Code.OK, "push"), outcome.message
    assert "the tool ended 11 mm from its goal" in outcome.message


def test_a_thin_heap_is_not_swept() -> None:
    flat = [replace(one, size=np.array([*one.size[:2], 0.004])) for one in (ROW.target, *ROW.others)]
    flat = [replace(one, T_base_object=se3.make(p=(*one.p_base[:2], 0.402))) for one in flat]
    for sweep in sweeps(crowd(*flat), hand(), CONTEXT, LENGTHS):
        assert push_ways(sweep.met, sweep.end, CONFIG, hand(), HAND) == ()


@pytest.mark.long
@pytest.mark.requirement("R-17")
def test_what_lies_over_others_is_pushed_off_them_above_their_tops() -> None:
    low = [standing(f"low{k}", 0.28 + 0.12 * np.cos(k), 0.15 + 0.12 * np.sin(k)) for k in range(7)]
    size = np.array([0.2, 0.2, 0.08])
    lid = replace(standing("lid", 0.28, 0.15), T_base_object=se3.make(p=(0.28, 0.15, low[0].top + 0.04)), size=size)
    heap, lengths = crowd(lid, *low), CONFIG.push.aside
    assert all(len(one.rest) < len(low) - 3 for one in sweeps(heap, hand(), CONTEXT, lengths))
    level = next(one for one in CONFIG.push.levels if one >= low[0].size[2])
    lines = sweeps(heap, hand(), CONTEXT, lengths, level=level)
    assert lines
    for sweep in lines:
        assert sweep.rest == heap.others
        assert sweep.met.bottom == pytest.approx(CONTEXT.table.top_z + level)
        assert all(box.T_frame_box[2, 3] - 0.5 * box.size[2] > low[0].top for box in sweep.heap)
        assert min(box.T_frame_box[2, 3] - 0.5 * box.size[2] for box in sweep.under) < low[0].top - 0.03
        for way in push_ways(sweep.met, sweep.end, CONFIG, hand(), HAND):
            assert way.T_base_tcp[2, 3] > low[0].top
    assert sweeps(heap, hand(), CONTEXT, lengths, level=0.15) == ()  # the hand would go over it


@pytest.mark.requirement("N-13")
def test_a_closed_hand_is_all_of_its_linkage_where_the_pads_meet() -> None:
    points = closed_hand(RobotDescription.load("ur5e"), "ur5e")
    front = points[points[:, 2] > 0.0]
    assert front[:, 2].max() == pytest.approx(0.0176, abs=1e-3)  # pads go forward as they close
    assert np.abs(front[:, 1]).max() < 0.04  # those of the open hand are beyond
