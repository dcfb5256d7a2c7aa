# SPDX-License-Identifier: Apache-2.0
"""From frames to one trusted object."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code, OpenArmError
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.config import DetectConfig
from openarm_grasp.perception.detections import Frame, Ids, average, find, in_base, on_table
from openarm_grasp.perception.sightings import seen_at
from tests.refusals import refused, refuses


def seen(label="red", x=0.26, y=-0.2, z=0.425, yaw=0.0, size=(0.04, 0.06, 0.05), score=0.9) -> Detection:
    T = se3.make(se3.rot_z(yaw), (x, y, z))
    return Detection(label, score, T, np.array(size), measured=score > 0.0)


def frames(*detections: tuple[Detection, ...], ids: Ids | None = None) -> list[Frame]:
    return followed((Frame(i * 100_000_000, d) for i, d in enumerate(detections)), ids)


def followed(seen: Iterable[Frame], ids: Ids | None = None) -> list[Frame]:
    return list(map((ids or Ids()).given, seen))


def look(seq, label="red", **kwargs):
    return find(seq, label, DetectConfig(agree_within=0.003), **kwargs)


def test_agreeing_frames_are_averaged_and_others_kept():
    blue = seen("blue", y=-0.35)
    sighting = look(frames((seen(x=0.260), blue), (seen(x=0.262), blue), (seen(x=0.261), blue)))
    assert sighting.target.p_base[0] == pytest.approx(0.261)
    assert [d.label for d in sighting.others] == ["blue"]
    assert sighting.t_ns == 200_000_000


@pytest.mark.parametrize(("looks", "expected"), [((True, True, False), True), ((True, False, False), False)])
def test_most_frames_say_whether_it_is_round(looks, expected):
    sequence = frames(*((replace(seen(), round=look),) for look in looks))
    target = look(in_base(sequence, lambda t_ns: se3.make(p=(0.1, 0.0, 0.0)))).target
    assert target.p_base[0] == pytest.approx(0.36)
    assert (target.round, on_table(target, 0.4).round) == (expected, expected)


def test_unknown_label_is_refused_with_what_is_in_view():
    with refuses(Code.UNKNOWN_OBJECT) as error:
        look(frames((seen("red"), seen("blue"))), "mug")
    assert error.value.message == "no 'mug' in view; in view: blue, red"


@pytest.mark.parametrize("code", [Code.INTRINSICS_MISMATCH, Code.TABLE_MISMATCH, Code.NOTHING_DETECTED])
@pytest.mark.requirement("R-15")
def test_what_its_detector_withholds_is_refused_with_the_reason(code):
    assert refused(None, look, frames(*[(replace(seen(), measured=False, code=code),)] * 3)).code is code


def test_an_empty_view_says_so():
    assert refused(None, look, frames((), ())).code is Code.NOTHING_DETECTED


@pytest.mark.parametrize(
    "sequence",
    [
        ((seen(x=0.26),), (seen(x=0.265),)),  # moves 5 mm
        ((), (seen(),)),  # has just come
        ((seen(),), ()),  # has just gone
        ((seen(x=0.36),), (seen(x=0.26),)),  # somewhere else
    ],
)
def test_an_object_that_moves_or_flickers_is_not_trusted(sequence):
    assert refused(None, look, frames(*sequence)).code is Code.STALE_DATA


def test_one_missed_frame_of_three_is_forgiven_and_two_are_not():
    assert look(frames((seen(),), (), (seen(),))).target.p_base[0] == pytest.approx(0.26)
    assert refused("in 1 of 3 frames only", look, frames((), (), (seen(),))).code is Code.STALE_DATA


@pytest.mark.requirement("B-27")
@pytest.mark.parametrize("text", ["", "cube"])
def test_of_several_that_fit_the_first_of_the_message_is_taken(text):
    """The detector has ranked them, by its policy; not the score, and not the one that was first before."""
    red, blue = replace(seen("red", score=0.5), kind="cube"), replace(seen("blue", y=0.2, score=0.8), kind="cube")
    assert look(frames((red, blue), (red, blue)), text).target.label == "red"
    assert look(frames((red, blue), (blue, red)), text).target.label == "blue"


@pytest.mark.requirement("R-18")
def test_what_is_known_of_an_object_outlives_the_average():
    can = replace(seen("cola"), color="blue", kind="can")
    target = look(frames((can,), (can,)), "blue can").target
    assert target.attributes == ("cola", "blue", "can", "cylinder")


@pytest.mark.requirement("R-18")
def test_the_same_object_is_followed_wherever_it_is_and_not_its_twin():
    """The words would choose the other one; what stood next to it and still does is not it."""
    a, b, ids = seen(x=0.20), seen(x=0.32), Ids()
    before = look(frames((a, b), ids=ids))
    moved = seen(x=0.50)
    assert look(frames((b, moved), ids=ids), same=before).target.p_base[0] == pytest.approx(0.50)
    assert look(frames((b, a), ids=ids), same=before).target.p_base[0] == pytest.approx(0.20)
    near = seen(x=0.28, y=-0.22)
    assert look(frames((b, near), ids=ids), same=before).target.p_base[0] == pytest.approx(0.28)
    with refuses(Code.UNKNOWN_OBJECT, r"'red' that was at .* is not in view; in view: red"):
        look(frames((b,), ids=ids), same=before)


@given(st.floats(-3.0, 3.0), st.integers(-2, 2))
def test_a_box_described_with_swapped_edges_is_the_same_box(yaw, turns):
    size = (0.04, 0.06, 0.05)
    turned = (size[1], size[0], size[2]) if turns % 2 else size
    mean = average([seen(yaw=yaw + turns * np.pi / 2, size=turned), seen(yaw=yaw, size=size)])
    assert mean.size == pytest.approx(size)
    assert abs(np.sin(mean.yaw - yaw)) < 1e-6


def test_a_box_on_the_table_ends_at_the_table():
    d = on_table(seen(z=0.43, size=(0.04, 0.04, 0.05)), 0.40)
    assert d.bottom == pytest.approx(0.40)
    assert d.top == pytest.approx(0.455)


def test_a_box_on_something_else_keeps_its_bottom():
    d = seen(z=0.50)
    assert on_table(d, 0.40) is d


def test_a_flat_detection_is_refused():
    refused("above the table", on_table, seen(z=0.39, size=(0.04, 0.04, 0.02)), 0.40)


def test_frames_move_to_the_base_frame_at_their_stamps():
    asked: list[int] = []

    def lookup(t_ns):
        asked.append(t_ns)
        return se3.make(p=(0.0, 0.0, 0.4))

    moved = in_base(frames((seen(z=0.025),), (seen(z=0.025),)), lookup)
    assert asked == [0, 100_000_000]
    assert moved[1].detections[0].p_base[2] == pytest.approx(0.425)


def test_of_several_alike_the_one_at_a_position_is_meant() -> None:
    both = (seen(x=0.2, score=0.9), seen(x=0.3, score=0.8))
    assert look(frames(both), at=(0.31, -0.2)).target.p_base[0] == pytest.approx(0.3)
    assert look(frames(both)).target.p_base[0] == pytest.approx(0.2)
    with refuses(Code.UNKNOWN_OBJECT, r"within 50 mm of \(0.400, -0.200\) m; it is seen at"):
        look(frames(both), at=(0.4, -0.2))


@pytest.mark.requirement("P-03")
def test_what_must_stay_is_not_picked_again() -> None:
    both = (seen(x=0.2), seen(x=0.3, score=0.8))
    assert look(frames(both), exclude_near=((0.21, -0.2),)).target.p_base[0] == pytest.approx(0.3)
    with refuses(Code.UNKNOWN_OBJECT, "besides 2 that must stay"):
        look(frames(both), exclude_near=((0.21, -0.2), (0.3, -0.2)))


def test_a_part_of_what_must_stay_is_not_picked() -> None:
    handle = seen(x=0.30, y=-0.1, yaw=1.5, size=(0.16, 0.02, 0.03))  # its end is where the middle of the whole is
    other = seen(x=0.22, y=-0.3, score=0.8)
    assert look(frames((handle, other)), exclude_near=((0.30, -0.185),)).target.p_base[1] == pytest.approx(-0.3)
    assert look(frames((handle, other)), exclude_near=((0.33, -0.185),)).target.p_base[1] == pytest.approx(-0.1)


def test_what_lies_around_something_that_must_stay_is_picked() -> None:
    around = seen(x=0.25, yaw=0.6, size=(0.19, 0.10, 0.008))  # open scissors with a tube between their blades
    inside = seen(x=0.30, y=-0.18, score=0.8, size=(0.05, 0.05, 0.05))
    assert look(frames((around, inside)), exclude_near=((0.30, -0.18),)).target.p_base[0] == pytest.approx(0.25)
    assert look(frames((around,)), exclude_near=((0.40, -0.18),)).target.p_base[0] == pytest.approx(0.25)
    refused("besides 1 that must stay", look, frames((around,)), exclude_near=((0.30, -0.18),))


def test_a_piece_of_what_must_stay_is_not_picked_however_far_from_its_middle() -> None:
    end = seen(x=0.30, y=-0.08, size=(0.02, 0.05, 0.01))
    neighbour = seen(x=0.34, y=-0.08, size=(0.02, 0.05, 0.01), score=0.8)
    whole = np.column_stack([np.full(20, 0.30), np.linspace(-0.25, -0.06, 20)])
    stay = ((0.30, -0.155),)
    assert look(frames((end, neighbour)), exclude_near=stay).target.p_base[0] == pytest.approx(0.30)
    found = look(frames((end, neighbour)), exclude_parts=(whole,))
    assert found.target.p_base[0] == pytest.approx(0.34)


def test_what_lies_where_something_stayed_that_is_not_there_any_more_is_picked() -> None:
    egg = np.stack(np.meshgrid(np.linspace(0.28, 0.32, 5), np.linspace(-0.22, -0.18, 5)), axis=-1).reshape(-1, 2)
    beside = seen(x=0.27, y=-0.24, yaw=0.3, size=(0.03, 0.12, 0.05))
    assert look(frames((beside,)), exclude_parts=(egg,)).target.p_base[0] == pytest.approx(0.27)
    for there in (seen(x=0.30, size=(0.05, 0.05, 0.05)), seen(x=0.28, y=-0.24, size=(0.10, 0.16, 0.05))):  # or its heap
        refused("besides 1 that must stay", look, frames((there,)), exclude_parts=(egg,))


def test_what_stands_close_to_what_must_stay_is_picked() -> None:
    left, close = seen(x=0.20, size=(0.02, 0.02, 0.05)), seen(x=0.235, score=0.8, size=(0.02, 0.02, 0.05))
    assert look(frames((left, close)), exclude_near=((0.203, -0.2),)).target.p_base[0] == pytest.approx(0.235)
    assert look(frames((left, close)), exclude_near=((0.232, -0.2),)).target.p_base[0] == pytest.approx(0.2)
    with pytest.raises(OpenArmError, match="besides 2 that must stay"):
        look(frames((left, close)), exclude_near=((0.218, -0.2),))  # two parts of one, or not: not picked


def test_what_is_not_measured_is_in_the_way_but_no_target() -> None:
    hidden = seen("blue", x=0.28, score=0.0)
    assert [d.label for d in look(frames((seen(), hidden))).others] == ["blue"]
    assert refused("cannot be measured", look, frames((seen(), hidden)), "blue").code is Code.NOTHING_DETECTED


def test_what_is_measured_in_one_frame_of_three_alone_cannot_be_measured() -> None:
    hidden = seen(x=0.27, score=0.0)
    assert refused("cannot be measured", look, frames((hidden,), (hidden,), (seen(),))).code is Code.NOTHING_DETECTED


def cloud_of(*detections: Detection) -> LabelledCloud:
    """Points on top of each detection, labelled by its number."""
    rng = np.random.default_rng(0)
    parts = [d.p_base + d.size * (rng.uniform(-0.5, 0.5, (200, 3)) * (1, 1, 0) + (0, 0, 0.5)) for d in detections]
    labels = np.repeat(np.arange(1, len(parts) + 1, dtype=np.uint32), 200)
    return LabelledCloud(np.concatenate(parts).astype(np.float32), labels, np.array([0.3, 0.0, 1.2]))


def test_a_part_of_something_of_unknown_shape_is_taken_on_its_points() -> None:
    part = seen("anything", score=0.0)
    sighting = look(followed(Frame(i, (part,), cloud_of(part)) for i in range(3)), "anything")
    assert not sighting.target.measured
    assert len(sighting.clouds) == 3
    for one in (seen("red", score=0.0), replace(part, code=Code.TABLE_MISMATCH)):
        sights = followed(Frame(i, (one,), cloud_of(one)) for i in range(3))
        assert refused(None, look, sights, one.label).code is one.code
    refused("cannot be measured", look, frames((part,), (part,), (part,)), "anything")


def test_what_is_seen_whole_comes_before_what_is_seen_in_part() -> None:
    part, whole = seen("anything", score=0.0), seen("anything", x=0.4)
    sighting = look(followed(Frame(i, (part, whole), cloud_of(part, whole)) for i in range(3)), "anything")
    assert sighting.target.measured
    assert sighting.target.p_base[0] == pytest.approx(0.4)


def test_what_a_frame_cut_off_is_whole_when_most_frames_show_all_of_it() -> None:
    part, whole = seen("anything", score=0.0), seen("anything")
    sights = followed(Frame(i, (d,), cloud_of(d)) for i, d in enumerate((whole, whole, part)))
    assert look(sights, "anything").target.measured
    assert not look(sights[1:], "anything").target.measured


def test_a_sighting_elsewhere_has_its_points_there_and_those_of_others_where_they_are() -> None:
    one, other = seen("anything"), seen("anything", y=-0.4)
    sights = followed(Frame(i, (one, other), cloud_of(one, other)) for i in range(3))
    sighting = look(sights, "anything", at=(0.26, -0.2))
    there = seen_at(sighting, (0.40, 0.1), np.pi / 2.0)
    assert there.target.p_base[:2] == pytest.approx((0.40, 0.1))
    for before, after in zip(sighting.clouds, there.clouds, strict=True):
        mine = before.labels == 1
        off = (before.points[mine] - one.p_base)[:, [1, 0]] * (-1, 1)
        assert after.points[mine][:, :2] == pytest.approx(off + np.array([0.40, 0.1]), abs=1e-6)
        assert (after.points[~mine] == before.points[~mine]).all()


@pytest.mark.requirement("R-17")
def test_what_is_one_thing_in_some_frames_and_two_in_the_newest_is_taken_as_the_newest_shows_it() -> None:
    one, other = (seen("anything", y=y, size=(0.06, 0.06, 0.05)) for y in (-0.2, -0.135))
    both = seen("anything", y=-0.1675, size=(0.06, 0.125, 0.05))
    apart_now = cloud_of(one, other)
    together = replace(apart_now, labels=np.ones_like(apart_now.labels))
    older = [Frame(i, (both,), together) for i in range(2)]
    sighting = look(followed([*older, Frame(2, (one, other), apart_now)]), "anything", at=(0.26, -0.2))
    assert sighting.target.p_base[1] == pytest.approx(-0.2)
    assert sighting.target.size[1] == pytest.approx(0.06)
    (cloud,) = sighting.clouds
    assert np.count_nonzero(cloud.labels == 1) == 200
    assert [d.p_base[1] for d in sighting.others] == [pytest.approx(-0.135)]  # and not both of before
    # one that was not there before has come
    came = Frame(2, (one,), cloud_of(one))
    gone = [Frame(i, (other,), cloud_of(other)) for i in range(2)]
    assert refused(None, look, followed([*gone, came]), "anything").code is Code.STALE_DATA
    # and what slides is not two things
    slid = [seen("anything", y=-0.2 + 0.025 * i, size=(0.06, 0.06, 0.05)) for i in range(3)]
    with refuses(Code.STALE_DATA):
        look(followed(Frame(i, (d,), cloud_of(d)) for i, d in enumerate(slid)), "anything")
