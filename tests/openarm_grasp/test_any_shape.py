# SPDX-License-Identifier: Apache-2.0
"""Things of any shape: found by depth, grasped on their clouds, judged by points and fingers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.scene.scene import Scene, load_scene, parse_scene
from openarm_evaluation.campaign.robot import SimulatedSenses
from openarm_evaluation.campaign.tasks.task import Task
from openarm_evaluation.campaign.trial import Trials
from openarm_grasp.config import GraspConfig
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.perception.sightings import in_box
from openarm_grasp.requests.task import Grasp
from openarm_grasp.robot.interface import PlanGrasp, Planned, PlanPlace
from openarm_grasp.sampling.views import views_of
from openarm_grasp.strategies import find, verify
from openarm_grasp.strategies.run import Run
from tests.openarm_grasp.recorded import Recordings, Requests


def alone(name: str, x: float, y: float, yaw: float, side: int = 0) -> Scene:
    """A scene with one object of models/objects on one of its sides, the most frequent first."""
    item = {"name": name, "shape": "mesh", "object": name, "side": side, "position": [x, y], "yaw": yaw}
    table = load_scene("empty").table.model_dump()
    return parse_scene({"name": "alone", "table": table, "objects": [item]}, "alone")


@pytest.mark.parametrize(("name", "y"), [("banana", -0.22), pytest.param("pear", 0.20, marks=pytest.mark.long)])
def test_what_is_no_prism_is_grasped_on_its_cloud_and_placed(name: str, y: float) -> None:
    senses = SimulatedSenses(depth_noise=True, detector="anything")
    trials = Trials(Task("nominal", 1, alone(name, 0.27, y, 0.4), ("anything",)), senses, GraspConfig())
    (grasp,) = trials.run()["grasps"]
    assert grasp["outcome"] == "placed", grasp["message"]
    said = " ".join(step.reason for step in trials.steps)
    assert "/cloud" in said
    assert "it has gone from its place" in said
    assert "mm from its target" in said


def test_images_of_one_camera_are_one_view_and_the_border_of_the_object_is_no_obstacle() -> None:
    points = np.array([[0.3, 0.0, 0.45], [0.306, 0.0, 0.446], [0.35, 0.0, 0.44], [0.3, 0.1, 0.40]], np.float32)
    labels = np.array([1, 0, 2, 0], np.uint32)
    over, hand = np.array([0.5, 0.0, 1.1]), np.array([0.3, 0.0, 0.7])
    clouds = [LabelledCloud(points, labels, camera) for camera in (over, over + 0.0005, hand)]
    first, second = views_of(clouds, 0.40)
    assert (len(first.target), len(first.others), len(first.table)) == (2, 2, 2)
    assert (len(second.target), len(second.others), len(second.table)) == (1, 1, 1)
    assert np.allclose(first.others[:, 0], 0.35)


@pytest.mark.long
def test_what_the_border_cuts_is_placed_when_all_of_it_is_seen_there(recorded: Recordings) -> None:
    outcome = recorded(alone("cereal_box", 0.22, 0.42, 0.3, side=3)).ask("anything")
    assert outcome.success, outcome.message
    assert "mm from where it was put down" in outcome.message


def test_where_the_points_of_what_was_placed_are_is_remembered(recorded: Recordings) -> None:
    robot = recorded(alone("banana", 0.27, -0.22, 0.4))
    place = tuple(robot.succeeds("anything").place_position[:2])
    near, (points,) = robot.session.parts_of((place,))
    assert near == ()
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    assert np.linalg.norm(middle - place) < 0.03
    assert 0.10 < np.linalg.norm(np.ptp(points, axis=0)) < 0.25
    elsewhere = (place[0] + 0.05, place[1])
    assert robot.session.parts_of((elsewhere,)) == ((elsewhere,), ())


def kept_banana(recorded: Recordings) -> tuple[Requests, str, Grasp]:
    """Pick the banana; returns the arm that holds it, and what it keeps."""
    robot = recorded(alone("banana", 0.27, -0.22, 0.4))
    robot.succeeds("anything", phase="pick")
    ((arm, kept),) = robot.session.kept.items()
    return robot, arm, kept


@pytest.mark.parametrize("in_part", [False, True])
def test_the_map_around_the_hand_is_in_no_way_where_more_than_was_seen_hangs_in_it(
    recorded: Recordings, monkeypatch, in_part
) -> None:
    robot, arm, kept = kept_banana(recorded)
    robot.session.kept[arm] = replace(kept, adjacent=(kept.sighting.target,) if in_part else ())
    plan, asked = robot.link.plan, list[PlanPlace]()

    async def watched(request: PlanGrasp | PlanPlace) -> Planned:
        asked.extend([request] if isinstance(request, PlanPlace) else [])
        return await plan(request)

    monkeypatch.setattr(robot.link, "plan", watched)
    p_base_tcp = robot.skills.T_base_tcp(arm)[:3, 3]
    robot.ask(phase="place")
    regions = [box for box in asked[0].ignore_regions if box.id.endswith("/hanging")]
    assert len(regions) == in_part
    assert all(box.T_frame_box[:3, 3] == pytest.approx(p_base_tcp, abs=0.01) for box in regions)
    assert asked[0].held


@pytest.mark.long
def test_among_other_things_the_place_is_planned_before_the_lift(recorded: Recordings) -> None:
    items = [
        {"name": name, "shape": "mesh", "object": name, "position": [0.27, y], "yaw": 0.4}
        for name, y in (("banana", -0.20), ("apple", -0.38))
    ]
    table = load_scene("empty").table.model_dump()
    robot = recorded(parse_scene({"name": "two", "table": table, "objects": items}, "two"))
    robot.succeeds()
    assert "planning the place" in robot.said


def test_one_image_that_shows_it_at_its_place_is_enough(recorded: Recordings, monkeypatch) -> None:
    """The newest of three shows only a part of it, as it may of a thin thing."""
    robot, _, _ = kept_banana(recorded)
    seen_in, asked = verify._seen, list[int]()

    def in_part(frame: Frame, *args) -> CameraVerdict:
        asked.append(1)
        return CameraVerdict(Code.PLACE_FAILED, "in part") if len(asked) == 1 else seen_in(frame, *args)

    monkeypatch.setattr(verify, "_seen", in_part)
    outcome = robot.ask(phase="place")
    assert (outcome.success, outcome.attempts, len(asked)) == (True, 1, 2), outcome.message
    assert "its middle is seen" in outcome.message


def test_what_has_turned_in_the_hand_is_put_down_and_not_said_to_be_placed_by_that(recorded: Recordings) -> None:
    robot, arm, kept = kept_banana(recorded)
    assert not kept.turned
    robot.session.kept[arm] = replace(kept, turned=True)
    outcome = robot.ask(phase="place")
    assert (outcome.success, outcome.attempts) == (True, 2), outcome.message  # it is taken up again from there
    assert "it had turned or slipped in the hand" in robot.said


def test_what_is_seen_away_from_its_target_is_not_said_to_be_placed(recorded: Recordings) -> None:
    robot, arm, kept = kept_banana(recorded)
    shifted = se3.make(p=(0.0, 0.030, 0.0)) @ kept.candidate.T_base_tcp
    robot.session.kept[arm] = replace(kept, candidate=replace(kept.candidate, T_base_tcp=shifted))
    outcome = robot.ask(phase="place")
    assert outcome.attempts == 2, outcome.message
    assert "mm from where it was put down, expected at most 15 mm" in robot.said


@pytest.mark.long
def test_what_was_seen_in_part_must_be_seen_within_half_of_what_counts_as_moved(recorded: Recordings) -> None:
    robot, arm, kept = kept_banana(recorded)
    part = replace(kept.sighting, target=replace(kept.sighting.target, measured=False))
    shifted = se3.make(p=(0.0, 0.014, 0.0)) @ kept.candidate.T_base_tcp
    robot.session.kept[arm] = replace(kept, sighting=part, candidate=replace(kept.candidate, T_base_tcp=shifted))
    robot.ask(phase="place")
    reasons = robot.said
    off = re.search(r"what was seen of it is (\d+) mm from where it was put down, expected at most 6 mm", reasons)
    assert off is not None
    assert int(off[1]) == pytest.approx(14, abs=2)


def test_what_has_gone_with_what_a_hand_keeps_may_be_a_part_of_it(recorded: Recordings) -> None:
    robot, arm, kept = kept_banana(recorded)
    gone = replace(kept.sighting.target, T_base_object=se3.make(p=(0.27, -0.16, 0.42)), size=np.full(3, 0.03))
    x, y = np.meshgrid(np.linspace(0.26, 0.28, 11), np.linspace(-0.17, -0.15, 11))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.43)]).astype(np.float32)
    cloud = kept.sighting.clouds[0]
    labels = np.concatenate([cloud.labels, np.full(len(points), 2, np.uint32)])
    cloud = replace(cloud, points=np.concatenate([cloud.points, points]), labels=labels)
    sighting = replace(kept.sighting, clouds=(cloud, *kept.sighting.clouds[1:]))
    robot.session.kept[arm] = replace(kept, sighting=sighting, adjacent=(gone,))
    outcome = robot.ask(phase="place")
    assert outcome.code is Code.PLACE_FAILED
    assert "has gone with it: it is a part of it" in outcome.message


@pytest.mark.parametrize("among", [False, True])
def test_what_was_seen_as_two_things_and_rises_as_one_is_placed_as_one_where_it_was_alone(
    recorded: Recordings, monkeypatch, among
) -> None:
    """One end of the wrench is taken for another thing, in the observation before the grasp alone."""

    def split(run: Run, frames: Sequence[Frame]) -> Sighting:
        found = located(run, frames)
        if run.tried:
            return found
        size, long = found.target.size.copy(), int(np.argmax(found.target.size[:2]))
        rest, end = (found.target.T_base_object @ se3.make(p=p * size[long] * np.eye(3)[long]) for p in (-0.1, 0.4))
        ratio = np.where(np.arange(3) == long, 0.2, 1.0)
        part = replace(found.target, T_base_object=end, size=ratio * size, score=0.5)
        target = replace(found.target, T_base_object=rest, size=np.where(ratio < 1.0, 0.8, 1.0) * size)
        clouds = []
        for cloud in found.clouds:
            away = in_box(cloud.points, part) & (cloud.labels == 1)
            clouds.append(replace(cloud, labels=np.where(away, 2, cloud.labels).astype(np.uint32)))
        away = se3.make(p=(0.0, 0.14, 0.0)) @ found.target.T_base_object
        others = (part, replace(part, T_base_object=away, size=np.full(3, 0.02))) if among else (part,)
        found = replace(found, target=target, others=others, clouds=tuple(clouds))
        run.findings.sighting = found
        return found

    located = find._locate
    monkeypatch.setattr(find, "_locate", split)
    robot = recorded(alone("wrench", 0.27, -0.22, 0.4))
    outcome = robot.ask("anything")
    assert outcome.attempts == 1, robot.said
    if among:
        assert outcome.code is Code.PLACE_FAILED
        assert "has gone with it: it may be another thing" in outcome.message
    else:
        assert outcome.code is Code.OK, outcome.message
