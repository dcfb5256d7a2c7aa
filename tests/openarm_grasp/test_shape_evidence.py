# SPDX-License-Identifier: Apache-2.0
"""Evidence for things of any shape: interval of the aperture; they have left their place, and rest at the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.camera import judge_gone, judge_held, judge_moved, judge_unmoved, stays
from openarm_grasp.evidence.verdicts import Evidence, judge_grip
from openarm_grasp.perception.clouds import came_next_to, lifted, risen_points, shown_at
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.perception.sightings import joined, object_points
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.neighbours import columns
from openarm_grasp.requests.task import Grasp

HELD = HeldConfig()
LIFT = np.array([0.0, 0.0, 0.12])


def grip(gap, **kwargs):
    return judge_grip(Evidence(gap, 0.03, -30.0, 0.0), HELD, apertures=(0.022, 0.041), **kwargs)


@pytest.mark.parametrize(
    ("gap", "code"),
    [
        (0.0171, Code.OK),
        (0.0459, Code.OK),
        (0.0165, Code.GRASP_MISSED),
        (0.0465, Code.HAND_COLLISION),
        (0.001, Code.GRASP_MISSED),
    ],
)
def test_the_gap_must_be_in_the_interval_of_the_contact_patch_within_the_tolerance(gap, code):
    assert grip(gap).code is code


def test_an_interval_that_begins_at_nothing_takes_no_closed_hand_for_held():
    assert judge_grip(Evidence(0.002, 0.01, -30.0, 0.0), HELD, apertures=(0.0, 0.02)).code is Code.GRASP_MISSED


def test_the_gap_after_closing_is_the_reference_for_slip():
    assert grip(0.031, was_held=True, closed=0.030).ok
    lost = grip(0.0345, was_held=True, closed=0.030)
    assert lost.code is Code.GRASP_LOST
    assert "34.5 mm" in lost.reason
    assert "30.0 mm" in lost.reason
    assert grip(0.0155, was_held=True, closed=0.0172).ok  # no longer the interval


def test_a_grasp_judges_its_hand_by_its_interval_and_by_how_far_it_had_closed():
    T = se3.make(se3.rot_x(np.pi), (0.27, -0.2, 0.42))
    up = np.array([0.0, 0.0, 0.12])
    candidate = GraspCandidate("pear/cloud0/tilt0", T, up, up, 0.03, 0.0, 1.0, {}, apertures=(0.022, 0.041))
    target = Detection("pear", 0.9, se3.make(p=(0.27, -0.2, 0.42)), np.array([0.06, 0.09, 0.04]), measured=False)
    grasp = Grasp("right", Sighting(target, (), 0), candidate, ())

    def gap(value):
        return Evidence(value, candidate.width, -30.0, 0.0)

    assert grasp.judge(gap(0.04), HELD).ok
    closed = replace(grasp, closed=0.036)
    assert closed.judge(gap(0.037), HELD, was_held=True).ok
    assert closed.judge(gap(0.040), HELD, was_held=True).code is Code.GRASP_LOST
    box = replace(grasp, candidate=replace(candidate, apertures=None))
    assert box.judge(gap(0.04), HELD).code is Code.HAND_COLLISION


@pytest.mark.requirement("R-16")
@pytest.mark.parametrize(("turn", "code"), [(0.0, Code.OK), (0.1, Code.OK), (0.5, Code.GRASP_LOST)])
def test_a_long_thing_that_turns_about_the_fingers_is_lost(turn, code):
    lies = slab(0.27, -0.2, half=(0.1, 0.015), top=0.42)
    T = se3.make(se3.rot_z(0.4), (0.05, 0.1, 0.12))
    end = np.array([0.17, -0.2, 0.42])
    points = se3.apply(T @ se3.make(se3.rot_y(turn), end) @ se3.make(p=-end), lies)
    standing = columns(lies, 0.40)
    assert judge_held(standing, points, T, HELD).code is code
    assert judge_held(standing, points[:0], T, HELD).ok  # what the hand hides proves nothing


@pytest.mark.requirement("R-16")
def test_what_hangs_in_the_hand_may_have_been_hidden_below_what_was_seen():
    lies = slab(0.27, -0.2, top=0.46)
    T = se3.make(p=(0.0, 0.0, 0.12))
    assert judge_held(columns(lies, 0.40), se3.apply(T, lies - (0.0, 0.0, 0.03)), T, HELD).ok
    assert not judge_held(columns(lies, 0.40), se3.apply(T, lies - (0.0, 0.0, 0.09)), T, HELD).ok


def slab(x, y, half=(0.05, 0.02), top=0.44, n=1500):
    rng = np.random.default_rng(int(1e3 * (x + 2 * y)) % 97)
    return np.column_stack([x + half[0] * rng.uniform(-1, 1, n), y + half[1] * rng.uniform(-1, 1, n), np.full(n, top)])


OVER = np.array([0.5, 0.0, 1.1])
GRIP = np.array([0.27, -0.20, 0.43])
HANDLE, HEAD, NEIGHBOUR = slab(0.27, -0.20), slab(0.35, -0.20, half=(0.02, 0.03)), slab(0.27, -0.15, half=(0.05, 0.01))


def boxed(points: np.ndarray) -> Detection:
    low, high = points.min(axis=0), points.max(axis=0)
    low[2] = 0.40
    return Detection("anything", 0.9, se3.make(p=0.5 * (low + high)), high - low)


def in_two() -> Sighting:
    """A thing that was seen as two, and a neighbour as near to it as its own part."""
    points = np.concatenate([HANDLE, HEAD, NEIGHBOUR]).astype(np.float32)
    labels = np.repeat([1, 2, 2], [len(HANDLE), len(HEAD), len(NEIGHBOUR)]).astype(np.uint32)
    return Sighting(boxed(HANDLE), (boxed(HEAD), boxed(NEIGHBOUR)), 0, (LabelledCloud(points, labels, OVER),))


def table() -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.0, 0.6, 0.005), np.arange(-0.5, 0.2, 0.005))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.40)])


def seen(*clusters: np.ndarray) -> list[Frame]:
    """A frame of things over a table of which an image shows all that nothing hides."""
    ground = table()
    for points in clusters:
        along = (ground - OVER)[:, None, :2] / (ground - OVER)[:, None, 2:]
        shadow = (points - OVER)[None, ::50, :2] / (points - OVER)[None, ::50, 2:]
        ground = ground[np.abs(along - shadow).max(axis=2).min(axis=1) > 0.012]
    points = np.concatenate([*clusters, ground]).astype(np.float32)
    sizes = [*map(len, clusters), len(ground)]
    labels = np.repeat([*range(1, len(clusters) + 1), 0], sizes).astype(np.uint32)
    return [Frame(1, tuple(map(boxed, clusters)), LabelledCloud(points, labels, OVER))]


@pytest.mark.requirement("R-16")
def test_what_rises_with_a_thing_as_one_body_is_a_part_of_it():
    found = in_two()
    T = se3.make(se3.rot_z(0.05), (0.0, 0.0, 0.12))
    risen = se3.apply(T, np.concatenate([HANDLE, HEAD]))
    whole = lifted(seen(risen, NEIGHBOUR), found, risen, T, GRIP)
    assert whole.others == (found.others[1],)
    assert len(object_points(whole.clouds)) == len(HANDLE) + len(HEAD)
    alone = se3.apply(T, HANDLE)
    assert lifted(seen(alone, HEAD, NEIGHBOUR), found, alone, T, GRIP) is found
    assert lifted(seen(risen, HEAD, NEIGHBOUR), found, risen, T, GRIP) is found  # its like still lies there
    assert lifted([Frame(1, ())], found, risen, T, GRIP) is found
    blind = LabelledCloud(np.empty((0, 3), np.float32), np.empty(0, np.uint32), OVER)
    assert lifted([Frame(1, (), blind)], found, risen, T, GRIP) is found
    assert lifted(seen(NEIGHBOUR), found, risen[:0], T, GRIP) is found


@pytest.mark.requirement("R-16")
def test_a_part_whose_end_alone_the_hand_does_not_hide_is_one():
    found = in_two()
    T = se3.make(p=(0.0, 0.0, 0.12))
    risen = se3.apply(T, HEAD[HEAD[:, 1] > -0.20])
    hidden = se3.apply(T, np.concatenate([HANDLE, HEAD[HEAD[:, 1] <= -0.20]]))
    frame = seen(risen, hidden, NEIGHBOUR)[0]
    cloud = frame.cloud
    kept = cloud.labels != 2  # the hand is there: it is no part of the cloud
    frame = replace(frame, cloud=replace(cloud, points=cloud.points[kept], labels=cloud.labels[kept]))
    assert lifted([frame], found, risen, T, GRIP).others == (found.others[1],)


@pytest.mark.requirement("R-16")
def test_what_was_taken_for_a_part_and_stays_is_another_thing():
    points = np.concatenate([HANDLE, HEAD, NEIGHBOUR]).astype(np.float32)
    labels = np.repeat([1, 1, 2], [len(HANDLE), len(HEAD), len(NEIGHBOUR)]).astype(np.uint32)
    both = boxed(np.concatenate([HANDLE, HEAD]))
    found = Sighting(both, (boxed(NEIGHBOUR),), 0, (LabelledCloud(points, labels, OVER),))
    T = se3.make(p=(0.0, 0.0, 0.12))
    frames = seen(se3.apply(T, HANDLE), HEAD, NEIGHBOUR)
    risen = risen_points(frames, found, HELD.rise)
    assert len(risen) == len(HANDLE)
    thing = lifted(frames, found, risen, T, GRIP)
    assert thing.target.p_base == pytest.approx(boxed(HANDLE).p_base, abs=0.004)
    assert thing.others[0] == found.others[0]
    assert thing.others[1].p_base == pytest.approx(boxed(HEAD).p_base, abs=0.004)


@pytest.mark.requirement("R-16")
def test_an_image_that_showed_only_what_stays_shows_nothing_of_the_thing():
    points = np.concatenate([HANDLE, HEAD]).astype(np.float32)
    both = LabelledCloud(points, np.ones(len(points), np.uint32), OVER)
    stays = LabelledCloud(HEAD.astype(np.float32), np.ones(len(HEAD), np.uint32), OVER)
    found = Sighting(boxed(points.astype(np.float64)), (), 0, (both, stays))
    T = se3.make(p=(0.0, 0.0, 0.12))
    risen = se3.apply(T, HANDLE)
    thing = lifted(seen(risen, HEAD), found, risen, T, GRIP)
    assert len(thing.clouds) == 1
    assert len(object_points(thing.clouds)) == len(HANDLE)


@pytest.mark.requirement("R-16")
def test_what_the_hand_hides_belongs_to_what_is_nearest_to_it():
    points = np.concatenate([HANDLE, HEAD]).astype(np.float32)
    both = boxed(points.astype(np.float64))
    found = Sighting(both, (), 0, (LabelledCloud(points, np.ones(len(points), np.uint32), OVER),))
    T = se3.make(p=(0.0, 0.0, 0.12))
    away = HEAD[:, 1] < -0.195
    hand = OVER + 0.6 * (HEAD[away] - OVER)
    risen = se3.apply(T, HANDLE)
    frame = seen(risen, HEAD[~away], hand)[0]
    cloud = frame.cloud
    kept = cloud.labels != 3  # the hand is no part of the cloud
    frame = replace(frame, cloud=replace(cloud, points=cloud.points[kept], labels=cloud.labels[kept]))
    thing = lifted([frame], found, risen, T, GRIP)
    assert thing.target.p_base == pytest.approx(boxed(HANDLE).p_base, abs=0.004)
    assert thing.others[0].p_base == pytest.approx(boxed(HEAD).p_base, abs=0.004)


def test_a_thing_with_its_part_is_one():
    found = in_two()
    whole = joined(found, found.others[:1])
    every = np.concatenate([HANDLE, HEAD])
    assert len(object_points(whole.clouds)) == len(every)
    assert whole.others == found.others[1:]
    assert whole.target.p_base == pytest.approx(boxed(every).p_base, abs=1e-6)
    assert whole.target.size == pytest.approx(boxed(every).size, abs=1e-6)
    assert whole.target.measured


CARRIED = se3.make(se3.rot_z(0.7), (0.1, 0.1, 0.0))


@pytest.mark.parametrize(
    ("change", "code", "words", "final"),
    [
        (se3.make(), Code.OK, " mm from where it was put down", False),
        (se3.make(p=(0.0, 0.004, 0.001)), Code.OK, " mm from where it was put down", False),
        (
            se3.make(p=(0.012, 0.0, 0.0)),
            Code.PLACE_FAILED,
            "mm from where it was put down, expected at most 6",
            False,
        ),
        (se3.make(p=(0.0, 0.0, 0.012)), Code.PLACE_FAILED, "12 mm higher than it was", True),
        (se3.make(p=(0.0, 0.0, -0.012)), Code.PLACE_FAILED, "does not rest as it did", True),
        (se3.make(p=(0.3, 0.3, 0.0)), Code.PLACE_FAILED, "does not rest as it did", False),  # it fell elsewhere
    ],
)
def test_what_was_seen_is_seen_where_the_hand_has_moved_it(change, code, words, final):
    frame = seen(se3.apply(change @ CARRIED, HANDLE))[0]
    T, verdict = judge_moved(HANDLE, CARRIED, frame, 0.006, in_part=False)
    assert (verdict.code, words in verdict.reason, verdict.final) == (code, True, final), verdict.reason
    if verdict.ok:
        at, there = (se3.apply(each, HANDLE.mean(axis=0)) for each in (T, change @ CARRIED))
        assert at == pytest.approx(there, abs=0.002)


def about(angle: float) -> np.ndarray:
    """A turn about the vertical through the middle of the handle, before it is carried."""
    middle = se3.make(p=HANDLE.mean(axis=0))
    return CARRIED @ middle @ se3.make(se3.rot_z(angle)) @ se3.inverse(middle)


@pytest.mark.parametrize(("angle", "code"), [(0.05, Code.OK), (0.4, Code.PLACE_FAILED)])
def test_what_has_turned_is_where_its_middle_is_unless_it_was_seen_in_part(angle, code):
    frame = seen(se3.apply(about(angle), HANDLE))[0]
    assert judge_moved(HANDLE, CARRIED, frame, 0.006, in_part=False)[1].ok
    verdict = judge_moved(HANDLE, CARRIED, frame, 0.006, in_part=True)[1]
    assert verdict.code is code, verdict.reason
    assert not verdict.final


def test_another_shape_is_not_what_was_put_down():
    frame = seen(se3.apply(CARRIED, slab(0.27, -0.20, half=(0.025, 0.02))))[0]
    verdict = judge_moved(HANDLE, CARRIED, frame, 0.006, in_part=False)[1]
    assert (verdict.code, verdict.final) == (Code.PLACE_FAILED, True)


def test_what_is_hidden_at_its_place_or_has_no_points_is_not_said_to_be_placed():
    there = se3.apply(CARRIED, HANDLE)
    hidden = judge_moved(HANDLE, CARRIED, seen(OVER + 0.6 * (there - OVER))[0], 0.006, in_part=False)[1]
    assert hidden.code is Code.PLACE_FAILED
    assert "of what was seen of it is in view" in hidden.reason
    assert judge_moved(HANDLE, CARRIED, Frame(1, ()), 0.006, in_part=False)[1].code is Code.STALE_DATA


def test_what_is_shown_at_a_place_is_what_most_of_the_points_there_belong_to():
    frame = seen(HANDLE, NEIGHBOUR)[0]
    one, points = shown_at(frame, HANDLE)
    assert one is frame.detections[0]
    assert len(points) == len(HANDLE)
    assert shown_at(frame, table()[:50])[0] is None
    assert shown_at(frame, HANDLE + np.array([0.0, 0.0, 0.1]))[0] is None
    assert shown_at(Frame(1, frame.detections), HANDLE)[0] is None


def test_what_came_next_to_a_placed_thing_may_be_a_part_of_it():
    before = Sighting(boxed(HEAD), (), 0, (seen(HEAD, NEIGHBOUR)[0].cloud,))
    for others, expected in (((), False), ((NEIGHBOUR,), False), ((slab(0.27, -0.255, half=(0.05, 0.01)),), True)):
        frame = seen(HANDLE, *others)[0]
        assert came_next_to(shown_at(frame, HANDLE)[1], frame, before) is expected


STANDING = seen(HANDLE, NEIGHBOUR)


@pytest.mark.parametrize(
    ("frames", "still", "words"),
    [
        (STANDING, True, "still stands"),
        (seen(np.concatenate([HANDLE, HEAD]), NEIGHBOUR), True, "still stands"),  # a part that was seen apart before
        (seen(OVER + 0.6 * (HANDLE - OVER)), True, "the hand hides"),
        ([], True, "the hand hides"),
        (seen(HANDLE + np.array([0.0, 0.012, 0.0])), False, "of it is not where it stood"),
        (seen(NEIGHBOUR), False, "of it is not where it stood"),
        (seen(NEIGHBOUR) + STANDING, True, "still stands"),
    ],
)
def test_what_has_moved_is_seen_through_where_it_stood(frames, still, words):
    said, why = judge_unmoved(HANDLE, frames)
    assert (said, words in why) == (still, True), why


@pytest.mark.parametrize(
    ("frames", "code", "words"),
    [
        (STANDING, Code.GRASP_MISSED, "still seen at its place"),
        (seen(NEIGHBOUR), Code.OK, "gone from its place"),
        (seen(NEIGHBOUR) + STANDING, Code.GRASP_MISSED, "still seen"),
        (seen(OVER + 0.6 * (HANDLE - OVER), NEIGHBOUR), Code.STALE_DATA, "hides where the object was"),
        (seen(OVER + 0.6 * (HANDLE - OVER), NEIGHBOUR) + seen(NEIGHBOUR), Code.OK, "gone from its place"),
        (seen(slab(0.27, -0.20, top=0.42)), Code.OK, "gone from its place"),  # what it lay on
        (seen(slab(0.28, -0.172, half=(0.06, 0.005), n=3000)), Code.OK, "gone from its place"),  # a neighbour
        ([], Code.STALE_DATA, "no camera frame"),
    ],
)
def test_an_object_has_gone_when_a_free_view_shows_its_place_empty(frames, code, words):
    verdict = judge_gone(HANDLE, frames, LIFT)
    assert (verdict.code, words in verdict.reason) == (code, True), verdict.reason
    assert stays(HANDLE, frames) is (not any(judge_gone(HANDLE, [one], LIFT).ok for one in frames))
