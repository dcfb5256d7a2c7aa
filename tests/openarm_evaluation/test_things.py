# SPDX-License-Identifier: Apache-2.0
"""Campaigns with objects of any shape: tasks, what a hand can grasp by the true mesh, judging, figures, options."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code, OpenArmError
from openarm_common.objects.model import object_names
from openarm_common.objects.posed import posed_object
from openarm_common.objects.resting import least_box_middles
from openarm_common.objects.solid import Part, hull_part
from openarm_common.robot.description import RobotDescription
from openarm_common.robot.folder import robot_work
from openarm_evaluation.campaign import report
from openarm_evaluation.campaign.options import CampaignOptions
from openarm_evaluation.campaign.tasks import settle, things
from openarm_evaluation.campaign.tasks.suites import make_task
from openarm_evaluation.campaign.tasks.things import REFUSED, object_sources
from openarm_evaluation.campaign.trial import crashed_row
from openarm_evaluation.judging import graspable
from openarm_evaluation.judging.graspable import ROOM, Graspable, GraspJudge, HandShape
from openarm_evaluation.judging.judge import RULES, Sample, fall_of, judge, rise_of
from openarm_evaluation.judging.trial import choose_targets
from openarm_evaluation.objects.household import HOUSEHOLD
from openarm_evaluation.objects.make import make_objects
from tests.refusals import refused

TOP = robot_work().table.top_z


def box(*edges: float) -> tuple[list[Part], float]:
    part = hull_part(np.array(list(itertools.product(*[(-0.5 * edge, 0.5 * edge) for edge in edges]))))
    assert part is not None
    return [part], edges[2]


def named(source: str, side: int = 0) -> tuple[list[Part], float]:
    posed = posed_object(source, side)
    return list(posed.parts), posed.size[2]


def decide(thing: tuple[list[Part], float], x: float = 0.27, y: float = -0.2, yaw: float = 0.5) -> Graspable:
    parts, height = thing
    T = se3.make(se3.rot_z(yaw)[:3, :3], (x, y, TOP + 0.5 * height))
    return GraspJudge.at(robot_work().table).decide(parts, T)


@pytest.mark.parametrize("yaw", [0.0, 0.5])
def test_a_box_is_graspable_up_to_the_aperture_less_the_room(yaw) -> None:
    opening = 2.0 * RobotDescription.load().hand("right").parts.opening
    good = decide(box(0.06, 0.06, 0.06), yaw=yaw)
    assert good.yes
    assert 0.0595 <= good.width <= 0.0755  # a face may lean a little from the pads
    assert good.arm == "right"
    assert decide(box(0.05, 0.05, 0.06), y=0.2, yaw=yaw).arm == "left"
    assert decide(box(opening - ROOM - 0.002, 0.1, 0.05), yaw=yaw).yes


@pytest.mark.long
def test_what_is_wider_than_the_aperture_less_the_room_or_flat_on_the_table_is_not_graspable(monkeypatch) -> None:
    monkeypatch.setattr(graspable, "_TILTS", (0.0, math.radians(15.0)))
    opening = 2.0 * RobotDescription.load().hand("right").parts.opening
    assert not decide(box(opening - ROOM + 0.004, 0.1, 0.03)).yes
    for thing in (box(0.1, 0.1, 0.02), box(0.03, 0.06, 0.004)):
        found = decide(thing)
        assert not found.yes
        assert "no section that the hand can close on" in found.reason


def test_long_things_are_graspable_by_a_part_of_them() -> None:
    hammer = decide(named("hammer"))
    assert hammer.yes
    assert hammer.width < 0.06  # not its 114 mm
    assert decide(named("mug", 2)).yes
    assert decide(named("banana")).yes


@pytest.mark.long
def test_what_is_far_away_is_out_of_reach() -> None:
    found = decide(box(0.05, 0.05, 0.05), x=0.75, y=-0.55)
    assert not found.yes
    assert found.reason.startswith("out of reach")


def test_the_grasp_of_the_judge_holds_the_object_between_the_pads_above_the_table() -> None:
    found = decide(named("screwdriver"))
    assert found.T_base_tcp is not None
    R = found.T_base_tcp[:3, :3]
    assert abs(R[2, 1]) < 1e-9  # it closes level
    assert math.acos(-R[2, 2]) == pytest.approx(found.tilt, abs=1e-6)
    assert found.tilt <= math.radians(45.0) + 1e-9
    hand = HandShape.of(RobotDescription.load(), found.arm)
    corners = np.array(
        [box[[i, j, k], range(3)] for box in hand.boxes for i, j, k in itertools.product((0, 1), repeat=3)]
    )
    assert se3.apply(found.T_base_tcp, corners)[:, 2].min() >= TOP + 0.002


@pytest.mark.long
def test_tasks_name_each_object_in_turn_and_are_the_same_each_time(tmp_path) -> None:
    make_objects(tmp_path, ("egg", "wedge"))
    tasks = [make_task("objects", seed, str(tmp_path)) for seed in range(3)]
    assert [task.scene.objects[0].object.rsplit("/", 1)[1] for task in tasks] == ["egg", "wedge", "egg"]
    assert tasks[2] == make_task("objects", 2, str(tmp_path))
    assert len({task.scene.appearance for task in tasks}) == 3
    for task in tasks:
        item = task.scene.objects[0]
        assert task.labels == ("anything",)
        assert [one.name for one in choose_targets(task.scene, "anything")] == ["thing"]
        if task.graspable[item.name]:
            assert task.codes == (Code.OK, *REFUSED)
        else:
            assert task.codes == (Code.OK,)


@pytest.mark.long
def test_a_heap_lies_at_rest_on_the_table_and_all_of_it_is_requested(monkeypatch) -> None:
    monkeypatch.setattr(GraspJudge, "decide", lambda self, parts, T: Graspable(True))
    task = make_task("heap", 3, "superquadrics:40")
    assert 5 <= len(task.scene.objects) <= 10
    assert task.labels == ("anything",) * len(task.scene.objects)
    assert task.clear
    assert make_task("heap", 3, "superquadrics:40") == task
    lowest = []
    for item in task.scene.objects:
        points = se3.apply(
            item.T_world_object(task.scene.table), np.concatenate([p.vertices for p in item.posed.parts])
        )
        lowest.append(points[:, 2].min() - TOP)
    assert min(lowest) > -0.002
    assert min(lowest) < 0.002


@pytest.mark.parametrize(("apart", "staying"), [(0.1, 2), (0.02, 0)])
def test_things_that_were_driven_into_each_other_are_no_heap(monkeypatch, apart: float, staying: int) -> None:
    for name, value in {"_FIRST": 0.045, "_NEXT": apart, "_FALL": 0.0, "_LIE": 0.0}.items():
        monkeypatch.setattr(settle, name, value)
    found = settle.dropped(("ball", "ball"), robot_work().table, (0.3, 0.0), 1e-3, np.random.default_rng(0))
    assert len(found) == staying


def test_a_heap_whose_objects_roll_off_the_table_is_refused(monkeypatch) -> None:
    monkeypatch.setattr(things, "dropped", lambda *_: [])
    with pytest.raises(OpenArmError, match="heap 3: fewer than 5 objects stay on the table in each of 20 drops"):
        make_task("heap", 3, "superquadrics:40")


def test_sources_of_objects_are_read_or_refused(tmp_path) -> None:
    assert object_sources("") == object_names()
    assert object_sources("superquadrics:3") == ("superquadric:0", "superquadric:1", "superquadric:2")
    for wrong, words in (("superquadrics:0", "N from 1"), (str(tmp_path), "no folder in it has an object.yaml")):
        refused(words, object_sources, wrong)
    refused("of the suites objects, heap, not of 'nominal'", make_task, "nominal", 0, "superquadrics:3")


def test_set_without_a_value_is_the_suite_and_depth_finds_what_has_no_colour() -> None:
    options = CampaignOptions(parameters=("objects", "grasp.attempts=2"), objects="superquadrics:5")
    assert (options.set_name, options.parameters, options.finder) == ("objects", ("grasp.attempts=2",), "anything")
    assert CampaignOptions().finder == "color"
    assert "--suite objects" in options.command(3)
    assert "--objects superquadrics:5" in options.command(3)
    assert options.settings()["objects"] == "superquadrics:5"
    refused("one suite at a time, got 'heap' and 'objects'", CampaignOptions, set_name="heap", parameters=("objects",))


def sample(t_s: float, z: float, down: float = 0.0, tilt: float = 0.0) -> Sample:
    q = np.array([math.sin(0.5 * tilt), 0.0, 0.0, math.cos(0.5 * tilt)])
    return Sample(round(t_s * 1e9), np.array([0.3, 0.0, z]), q, np.array([0.0, 0.0, -down]), np.zeros(3))


def lifted(*between: Sample, tilt: float = 0.0) -> list[Sample]:
    return [sample(0.0, 0.42), sample(0.1, 0.55), *between, sample(1.0, 0.43, tilt=tilt), sample(1.6, 0.43, tilt=tilt)]


#: Corners of an object of any shape.
CUBE = 0.02 * np.array(list(itertools.product((-1.0, 1.0), repeat=3)))


def test_an_object_of_any_shape_may_rest_on_another_side_but_not_fall() -> None:
    other = lifted(tilt=1.5)
    assert judge(other, (0.3, 0.0), claimed=True, corners=CUBE).placed
    assert not judge(other, (0.3, 0.0), claimed=True).placed
    falling = lifted(sample(0.2, 0.55), sample(0.25, 0.54, 0.49), sample(0.3, 0.50, 0.98), sample(0.32, 0.45))
    assert fall_of(falling) == pytest.approx(0.049, abs=1e-3)
    found = judge(falling, (0.3, 0.0), claimed=True, corners=CUBE)
    assert not found.placed
    assert found.false_success
    assert found.reasons == (f"fell: 49 mm freely, at most {1e3 * RULES.fall:.0f} are allowed",)
    later = [replace(one, t_ns=one.t_ns + 2_000_000_000) for one in lifted()]
    assert judge([*falling, *later], (0.3, 0.0), claimed=True, corners=CUBE).placed  # of an attempt that failed
    lowered = lifted(sample(0.2, 0.54, 0.2), sample(0.3, 0.52, 0.4), sample(0.4, 0.48, 0.5))
    assert judge(lowered, (0.3, 0.0), claimed=True, corners=CUBE).placed
    assert rise_of(lowered) == pytest.approx(0.13)


def test_of_rectangles_that_are_as_small_the_nearest_counts() -> None:
    """About a pan lie two, mirrored at its handle; their middles are 44 mm apart."""
    corners = posed_object("pan").corners
    middles = least_box_middles(corners[:, :2], 1e-6)
    assert len(middles) == 2
    assert np.ptp(middles, axis=0) == pytest.approx((0.041, 0.015), abs=1e-3)
    for x, y in middles:
        assert judge(lifted(), (0.3 + x, y), claimed=True, corners=corners).place_error < 1e-6
    for line in (np.empty((0, 2)), corners[:1, :2], np.outer(np.arange(5.0), (1.0, 2.0))):
        assert len(least_box_middles(line)) == 0
    x, y = middles.mean(axis=0) + np.array([-0.015, 0.041])
    assert judge(lifted(), (0.3 + x, y), claimed=True, corners=corners).false_success


def test_figures_say_what_is_graspable_and_what_of_it_was_placed() -> None:
    task = make_task("objects", 0, "superquadrics:1")
    whys = ["", "", "no section"]
    rows = []
    for k, why in enumerate(whys):
        row = crashed_row(task, RuntimeError("x")) | {"seed": k, "detector": "anything", "sim_s": 20.0}
        row["things"] = {"thing": {"object": f"/a/object_{k}", "side": 0, "why_not": why}}
        grasp = {"target": "thing", "placed": k == 0, "arm": "right", "code": "OK" if k == 0 else "TOO_WIDE"}
        grasp["states"] = [{"state": state, "seconds": 1.0} for state in ("DETECT", "TRANSFORM", "PLAN")[: 3 - k]]
        grasp["claimed_success"] = k == 0
        rows.append(row | {"grasps": [grasp | {"place_error_mm": 1.0, "sim_s": 20.0}]})
    s = report.summarise(rows)
    assert (s["graspable"]["count"], s["graspable"]["n"]) == (2, 3)
    assert (s["cleared"]["count"], s["cleared"]["n"]) == (1, 2)
    assert s["refused"] == {"TOO_WIDE": 2}
    assert s["reached"] == {
        "seen": 2, "grasps found": 1, "planned": 0, "held": 0, "lifted": 0, "placed": 1, "claimed": 1
    }  # fmt: skip
    assert s["picks_per_hour"] == 60
    assert s["waiting"] is None
    told = dict(
        report.figures(
            {"summary": s, "asked": 3, "scenes_per_hour": None, "machine": {"cores": 1, "cpu": ""}, "wall_s": 1.0}
        )
    )
    assert told["graspable, as judged on the true meshes"].startswith("2 of 3")
    assert told["graspable ones not placed"] == "object_1 1 of 1"


def test_the_folders_of_the_suite_are_those_that_are_made(tmp_path) -> None:
    assert set(object_names()) == set(HOUSEHOLD)
    (folder,) = make_objects(tmp_path, ("mug",))
    made, kept = posed_object(str(folder)), posed_object("mug")
    assert made.size == pytest.approx(kept.size, abs=1e-4)
    assert len(made.parts) == len(kept.parts)
    refused("no object 'nothing'; objects: apple", make_objects, tmp_path, ("nothing",))


def test_figures_say_what_share_of_the_time_arms_wait() -> None:
    row = crashed_row(make_task("pairs", 0, ""), RuntimeError("x")) | {"detector": "color", "sim_s": 10.0}
    grasp = {"target": "a", "placed": True, "code": "OK", "place_error_mm": 1.0}
    row["grasps"] = [grasp | {"arm": "left", "sim_s": 10.0}, grasp | {"arm": "right", "sim_s": 6.0}]
    assert report.summarise([row | {"arm_clearance_mm": 50.0}])["waiting"] == pytest.approx(0.2)
