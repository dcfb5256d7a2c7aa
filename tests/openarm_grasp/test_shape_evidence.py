# SPDX-License-Identifier: Apache-2.0
"""Evidence for things of any shape: interval of the aperture, clusters that left their place and rest at the target."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.shapes import (
    Cluster,
    is_more,
    judge_gone,
    judge_held,
    judge_moved,
    judge_rests,
    judge_unmoved,
    stays,
)
from openarm_grasp.evidence.verdicts import Evidence, judge_grip
from openarm_grasp.perception.clouds import came_next_to, lifted, risen_points
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.perception.sightings import joined, object_points
from openarm_grasp.planning.candidates import GraspCandidate
from openarm_grasp.planning.neighbours import columns
from openarm_grasp.requests.task import Grasp

HELD = HeldConfig()
STOOD = Cluster(np.array([0.27, -0.2, 0.42]), 0.44, 0.12, 800)


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


def at(x, y, **changes):
    return replace(STOOD, centroid=np.array([x, y, STOOD.centroid[2]]), **changes)


@pytest.mark.parametrize(
    ("clusters", "code", "words"),
    [
        ([at(0.31, 0.101)], Code.OK, "mm from its target"),
        ([at(0.33, 0.1)], Code.PLACE_FAILED, "30 mm from its target"),
        ([at(0.30, 0.1, top=0.455)], Code.PLACE_FAILED, "15 mm higher"),
        ([at(0.30, 0.1, top=0.43)], Code.PLACE_FAILED, "10 mm lower"),
        ([at(0.30, 0.1, extent=0.16)], Code.PLACE_FAILED, "40 mm longer"),
        ([at(0.30, 0.1, extent=0.08)], Code.PLACE_FAILED, "40 mm shorter"),
        ([at(0.30, 0.1, extent=0.099)], Code.PLACE_FAILED, "21 mm shorter"),
        ([at(0.30, 0.1, cut=True)], Code.PLACE_FAILED, "cut off"),
        ([at(0.30, 0.1, points=100)], Code.PLACE_FAILED, "not in view"),
        ([], Code.PLACE_FAILED, "not in view"),
    ],
)
def test_a_thing_rests_where_its_middle_is_as_high_and_as_long_as_before(clusters, code, words):
    verdict = judge_rests(STOOD, np.array([0.30, 0.1]), clusters, 0.02)
    assert verdict.code is code
    assert words in verdict.reason


def test_the_middle_is_that_of_the_outline_however_many_points_are_on_one_end():
    x, y = np.meshgrid(np.linspace(0.0, 0.2, 41), np.linspace(0.0, 0.04, 9))
    plate = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 0.42)])
    one_end = np.concatenate([plate, np.repeat(plate[plate[:, 0] < 0.05], 5, axis=0)])
    cluster = Cluster.of(one_end)
    assert cluster.centroid[0] < 0.08
    assert cluster.away_from(np.array([0.1, 0.02])) < 0.001
    verdict = judge_rests(Cluster.of(plate), np.array([0.1, 0.02]), [cluster], 0.015)
    assert verdict.ok, verdict.reason


def test_what_was_cut_off_when_it_was_first_seen_is_never_said_to_be_placed():
    verdict = judge_rests(replace(STOOD, cut=True), np.array([0.30, 0.1]), [at(0.30, 0.1)], 0.02)
    assert verdict.code is Code.PLACE_FAILED


@pytest.mark.requirement("R-16")
def test_what_lay_on_something_else_may_rest_lower_and_longer():
    p = np.array([0.30, 0.1])
    lower, higher, short = at(0.30, 0.1, top=0.428, extent=0.16), at(0.30, 0.1, top=0.455), at(0.30, 0.1, extent=0.08)
    assert not judge_rests(STOOD, p, [lower], 0.02).ok
    assert judge_rests(STOOD, p, [lower], 0.02, leaned=True).ok
    assert not judge_rests(STOOD, p, [higher], 0.02, leaned=True).ok
    assert not judge_rests(STOOD, p, [short], 0.02, leaned=True).ok


def test_a_cluster_is_measured_without_its_few_flying_points():
    rng = np.random.default_rng(3)
    points = np.column_stack(
        [rng.uniform(0.2, 0.3, 2000), rng.uniform(-0.22, -0.18, 2000), rng.uniform(0.4, 0.44, 2000)]
    )
    points[::200] += (0.0, 0.0, 0.3)
    points[5] = np.nan
    cluster = Cluster.of(points.reshape(-1, 10, 3))
    assert cluster.points == 1999
    assert cluster.top == pytest.approx(0.44, abs=0.002)
    assert cluster.extent == pytest.approx(0.1, abs=0.006)
    with pytest.raises(OpenArmError, match="without finite points"):
        Cluster.of(np.full((4, 3), np.nan))


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


@pytest.mark.parametrize(("off", "code"), [(0.0, Code.OK), (0.004, Code.OK), (0.03, Code.PLACE_FAILED)])
def test_what_was_seen_in_part_must_be_seen_where_the_hand_has_moved_it(off, code):
    part = slab(0.27, -0.2)
    part = part[part[:, 0] < 0.27]  # the other half was hidden
    T = se3.make(se3.rot_z(0.7), (0.1, 0.3, 0.0))
    now = slab(0.27 + off, -0.2) @ T[:3, :3].T + T[:3, 3]
    assert judge_moved(part, T, now, HELD.moved).code is code
    assert judge_moved(part, T, np.empty((0, 3)), HELD.moved).code is Code.PLACE_FAILED


@pytest.mark.parametrize(("hidden", "more"), [(0.0, False), (0.01, False), (0.05, True)])
def test_what_is_larger_at_its_place_was_seen_in_part(hidden, more):
    part = slab(0.27, -0.2)
    part = part[part[:, 0] < 0.32 - hidden]
    T = se3.make(se3.rot_z(0.7), (0.1, 0.3, 0.0))
    assert is_more(slab(0.27, -0.2) @ T[:3, :3].T + T[:3, 3], part, T, HELD.moved) is more


def test_what_came_next_to_a_placed_thing_may_be_a_part_of_it():
    size = np.array([0.06, 0.06, 0.04])
    thing, stood = (Detection("anything", 0.9, se3.make(p=(x, -0.2, 0.42)), size) for x in (0.3, 0.38))
    part = Detection("anything", 0.9, se3.make(p=(0.3, -0.12, 0.41)), np.array([0.02, 0.08, 0.02]))
    for seen, expected in (((thing,), False), ((thing, stood), False), ((thing, stood, part), True)):
        assert came_next_to(thing, (stood,), [Frame(1, seen), Frame(2, ())], 0.03) is expected


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


STANDING = seen(HANDLE, NEIGHBOUR)


def test_a_part_that_was_seen_apart_before_has_not_moved():
    now = np.concatenate([HANDLE, HEAD])
    assert judge_unmoved(HANDLE, now, HELD, HEAD) == (True, "the object still stands there")
    assert not judge_unmoved(HANDLE, now, HELD, NEIGHBOUR)[0]


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
    verdict = judge_gone(HANDLE, frames, HELD)
    assert (verdict.code, words in verdict.reason) == (code, True), verdict.reason
    assert stays(HANDLE, frames, HELD) is (not any(judge_gone(HANDLE, [one], HELD).ok for one in frames))
