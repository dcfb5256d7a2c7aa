# SPDX-License-Identifier: Apache-2.0
"""Evidence for boxes: situations and verdicts, on images of depth and on boxes alone, of which points are made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.camera.cameras import Intrinsics
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.config import HeldConfig
from openarm_grasp.evidence.camera import judge_gone, judge_held, judge_moved, judge_same, judge_unmoved
from openarm_grasp.evidence.verdicts import CameraVerdict
from openarm_grasp.perception.boxes import points_of, with_points
from openarm_grasp.perception.clouds import risen_points, shown_at
from openarm_grasp.perception.detections import Frame, Sighting
from openarm_grasp.planning.neighbours import columns
from tests.openarm_grasp.clouds import SLANTED, TABLE_Z, seen

HELD = HeldConfig()
LENS = Intrinsics.from_fovy(640, 480, 60.0)
AHEAD = np.array([0.27, -0.1, TABLE_Z]) - SLANTED
T_CAMERA = se3.make(se3.rotation_from_z_y(AHEAD, (-1.0, 0.0, 0.0)), SLANTED)
TABLE = np.array([(x, y, z) for x in (0.0, 0.5) for y in (-0.35, 0.1) for z in (TABLE_Z - 0.02, TABLE_Z)])
TOP = np.array([(x, y, z) for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
CUBE, BRICK, TALL = (0.05, 0.05, 0.05), (0.06, 0.07, 0.04), (0.04, 0.06, 0.09)
HERE, THERE = (0.27, -0.2), (0.2, -0.05)
LIFT = np.array([0.0, 0.0, 0.12])


def box(at=HERE, size=CUBE, yaw=0.0, up=0.0, label="red") -> Detection:
    T = se3.make(se3.rot_z(yaw), (*at, TABLE_Z + up + 0.5 * size[2]))
    return Detection(label, 0.9, T, np.array(size), kind="box")


def tipped(one: Detection, R: np.ndarray) -> Detection:
    """It rests turned, on an edge or on another face."""
    T = se3.make(one.T_base_object[:3, :3] @ R, one.p_base)
    T[2, 3] += TABLE_Z - (se3.apply(T, TOP * one.size)[:, 2]).min()
    return replace(one, T_base_object=T)


def measured(*things: Detection) -> Frame:
    """An image of depth: points of whatever stands there, labelled by the thing they are nearest to."""
    parts = [se3.apply(one.T_base_object, TOP * one.size) for one in things]
    points = seen([*parts, TABLE], SLANTED, step=0.002)
    labels = np.zeros(len(points), np.uint32)
    for number, one in enumerate(things, start=1):
        local = np.abs(se3.apply(se3.inverse(one.T_base_object), points)) - 0.5 * one.size
        labels[(local.max(axis=1) < 1e-4) & (points[:, 2] > TABLE_Z + 1e-4)] = number
    return Frame(1, things, LabelledCloud(points.astype(np.float32), labels, SLANTED))


def upright(*things: Detection) -> Frame:
    """What a detector without depth says: upright boxes about what stands there."""
    found: list[Detection] = []
    for one in things:
        T = se3.make(se3.rot_z(one.yaw), one.p_base)
        local = se3.apply(se3.inverse(T) @ one.T_base_object, TOP * one.size)
        found.append(replace(one, T_base_object=T, size=np.ptp(local, axis=0), kind=""))
    return with_points(Frame(1, tuple(found)), LENS, T_CAMERA, TABLE_Z)


Image = Callable[..., Frame]
IMAGES = pytest.mark.parametrize("image", [measured, upright])


def points(frame: Frame) -> np.ndarray:
    return frame.cloud.points[frame.cloud.labels == 1].astype(np.float64)


def placed(image: Image, before: Detection, now: Detection | None, target: Detection) -> CameraVerdict:
    """The verdict on what stood before, was put down at its target, and looks so now."""
    first = image(before)
    T_motion = target.T_base_object @ se3.inverse(before.T_base_object)
    frame = image(*(one for one in (now,) if one is not None))
    T, verdict = judge_moved(points(first), T_motion, frame, 0.015, in_part=False)
    return judge_same(shown_at(frame, se3.apply(T, points(first)))[1], T, first.cloud) if verdict.ok else verdict


# --- before the grasp
@IMAGES
@pytest.mark.parametrize(
    ("now", "still"),
    [
        ((box(),), True),
        ((box(at=(0.272, -0.2)),), True),
        ((box(at=(0.282, -0.2)),), False),
        ((box(at=(0.27, -0.17)),), False),
        ((box(at=(0.40, -0.2)),), False),
        ((box(yaw=0.6),), False),
        ((box(label="blue"),), True),  # what stands there is what stood there, whatever it is called now
        ((), False),
        ((box(at=(0.33, -0.13), size=(0.03, 0.03, 0.30)), box()), True),  # hides a part of it
    ],
)
@pytest.mark.requirement("N-03")
def test_an_object_that_has_moved_is_noticed_before_the_hand_goes_down(image, now, still) -> None:
    assert judge_unmoved(points(image(box())), [image(*now)])[0] is still


@pytest.mark.requirement("N-03")
def test_what_the_robot_hides_has_not_moved_and_has_not_gone() -> None:
    robot = np.ones((LENS.height, LENS.width), np.bool_)
    hidden = with_points(Frame(1, ()), LENS, T_CAMERA, TABLE_Z, robot)
    assert not len(hidden.cloud.points)
    assert judge_unmoved(points(upright(box())), [hidden])[0]
    assert judge_gone(points(upright(box())), [hidden], LIFT).code is Code.STALE_DATA


@pytest.mark.requirement("N-03")
def test_of_what_is_seen_in_part_nothing_is_known() -> None:
    in_part = replace(box(size=(0.03, 0.03, 0.03)), measured=False)
    hidden = with_points(Frame(1, (in_part,)), LENS, T_CAMERA, TABLE_Z, np.ones((LENS.height, LENS.width), np.bool_))
    assert not len(hidden.cloud.points)
    assert judge_unmoved(points(upright(box())), [hidden])[0]


# --- after the lift
@IMAGES
@pytest.mark.parametrize(
    ("after", "code", "reason"),
    [
        ([], Code.STALE_DATA, "no camera frame"),
        ([()], Code.OK, "has gone"),
        ([(box(at=(0.40, -0.2)),)], Code.OK, "has gone"),
        ([(box(),)], Code.GRASP_MISSED, "still seen at its place"),
        ([(box(label="blue"),)], Code.GRASP_MISSED, "still seen at its place"),
        ([(box(at=(0.28, -0.2)),)], Code.GRASP_MISSED, "still seen at its place"),
        ([(box(up=0.02),)], Code.GRASP_MISSED, "hides where the object was"),
        ([(box(up=0.12),)], Code.OK, "has gone"),
        ([(box(size=(0.05, 0.05, 0.17)),)], Code.OK, "has gone"),  # it hangs in the hand, and is taken for a tall box
        ([(box(size=(0.05, 0.05, 0.15)),)], Code.GRASP_MISSED, "still seen at its place"),  # it would have slipped
        ([(box(at=(0.29, -0.2), size=(0.05, 0.05, 0.17)),)], Code.GRASP_MISSED, ""),  # it would be held by an edge
        ([(), (box(),)], Code.GRASP_MISSED, "still seen at its place"),
        ([(box(),), ()], Code.GRASP_MISSED, "still seen at its place"),
        ([(box(at=(0.27, -0.14)),)], Code.OK, "has gone"),  # its twin, next to it
        ([(box(at=(0.27, -0.14), size=TALL),)], Code.OK, "has gone"),
    ],
)
@pytest.mark.requirement("P-08")
def test_an_object_has_left_its_place_when_it_is_seen_through(image, after, code, reason) -> None:
    verdict = judge_gone(points(image(box())), [image(*one) for one in after], LIFT)
    if code is Code.GRASP_MISSED and reason == "hides where the object was":
        assert not verdict.ok  # a hand that holds it so low hides its place, or it is seen there
        return
    assert (verdict.code, reason in verdict.reason) == (code, True), verdict.reason


@pytest.mark.parametrize("size", [CUBE, BRICK, TALL])
@pytest.mark.parametrize(
    ("aside", "down", "code"),
    [
        (0.0, 0.0, Code.OK),
        (0.0, 0.03, Code.GRASP_LOST),  # it has slipped along the fingers
        (0.0, 0.04, Code.GRASP_LOST),
        (0.035, 0.0, Code.GRASP_LOST),  # it is held by an edge
        (0.02, 0.03, Code.GRASP_LOST),
    ],
)
@pytest.mark.requirement("P-07", "P-08")
def test_what_hangs_elsewhere_in_the_hand_than_it_should_is_seen_beside_or_below_it(size, aside, down, code) -> None:
    """The detector takes for the hand what is within 1 cm of where the object should hang."""
    before, lifted = box(size=size), se3.make(p=(0.0, 0.0, 0.12))
    first = measured(before)
    hangs = box(at=(HERE[0], HERE[1] + aside), size=size, up=0.12 - down)
    frame = measured(hangs)
    held = np.abs(se3.apply(se3.inverse(lifted @ before.T_base_object), frame.cloud.points)) <= 0.5 * before.size + 0.01
    kept = ~(held.all(axis=1) & (frame.cloud.labels == 1))
    frame = replace(frame, cloud=replace(frame.cloud, points=frame.cloud.points[kept], labels=frame.cloud.labels[kept]))
    sighting = Sighting(before, (), 0, (first.cloud,))
    assert judge_gone(points(first), [frame], LIFT).ok
    risen = risen_points([frame], sighting, HELD.rise)
    verdict = judge_held(columns(points(first), TABLE_Z), risen, lifted, HELD)
    assert verdict.code is code, verdict.reason


# --- at the place
@IMAGES
@pytest.mark.parametrize("size", [CUBE, BRICK, TALL])
@pytest.mark.parametrize(
    ("step", "code", "final"),
    [
        ((0.0, 0.0), Code.OK, False),
        ((0.005, -0.005), Code.OK, False),
        ((0.012, 0.0), Code.OK, False),
        ((0.0, 0.019), Code.PLACE_FAILED, False),
        ((0.0, 0.04), Code.PLACE_FAILED, False),
        ((0.1, -0.1), Code.PLACE_FAILED, False),
    ],
)
@pytest.mark.requirement("P-09")
def test_a_place_counts_when_the_camera_sees_it_within_three_quarters_of_2_cm(image, size, step, code, final) -> None:
    before, target = box(size=size), box(at=THERE, size=size, yaw=1.2)
    now = box(at=np.add(THERE, step), size=size, yaw=1.2)
    verdict = placed(image, before, now, target)
    assert (verdict.code, verdict.final) == (code, final), verdict.reason


@IMAGES
@pytest.mark.requirement("P-09")
def test_what_is_not_there_at_all_may_be_picked_again(image) -> None:
    verdict = placed(image, box(), None, box(at=THERE))
    assert (verdict.code, verdict.final) == (Code.PLACE_FAILED, False)


@IMAGES
@pytest.mark.parametrize("turn", [se3.rot_x(np.pi / 2.0), se3.rot_y(np.pi / 2.0)])
@pytest.mark.parametrize("size", [BRICK, TALL, (0.05, 0.056, 0.05 + 0.006)])
@pytest.mark.requirement("P-09")
def test_what_has_fallen_over_is_not_placed(image, size, turn) -> None:
    target = box(at=THERE, size=size, yaw=0.4)
    verdict = placed(image, box(size=size), tipped(target, turn), target)
    same = np.abs(np.abs(turn) @ size - size).max() < 0.004
    assert (verdict.code is Code.PLACE_FAILED) is not same, verdict.reason


@IMAGES
@pytest.mark.parametrize("turn", [se3.rot_x, se3.rot_y])
@pytest.mark.parametrize("size", [CUBE, BRICK, TALL])
@pytest.mark.requirement("P-09")
def test_what_leans_by_15_degrees_is_not_placed_and_no_other_try_would_help(image, size, turn) -> None:
    target = box(at=THERE, size=size, yaw=0.4)
    for angle in np.radians((15.0, -15.0)):
        verdict = placed(image, box(size=size), tipped(target, turn(angle)), target)
        assert verdict.code is Code.PLACE_FAILED, verdict.reason
        assert verdict.final or image is upright  # a box about it may hide its place


@IMAGES
@pytest.mark.parametrize("size", [(0.062, 0.062, 0.05), (0.05, 0.07, 0.05), (0.05, 0.05, 0.06), (0.05, 0.05, 0.04)])
@pytest.mark.requirement("P-09")
def test_something_larger_higher_or_lower_is_not_what_was_put_down(image, size) -> None:
    verdict = placed(image, box(), box(at=THERE, size=size), box(at=THERE))
    assert (verdict.code, verdict.final) == (Code.PLACE_FAILED, True), verdict.reason


# --- points of boxes
def test_a_camera_sees_the_near_faces_of_boxes_and_the_table_around() -> None:
    cloud = points_of((box(), box(at=THERE, size=TALL)), LENS, T_CAMERA, TABLE_Z)
    for number, one in enumerate((box(), box(at=THERE, size=TALL)), start=1):
        local = se3.apply(se3.inverse(one.T_base_object), cloud.points[cloud.labels == number])
        assert np.abs(np.abs(local) / (0.5 * one.size)).max(axis=1) == pytest.approx(1.0, abs=1e-3)
        normal = np.sign(local) * (np.abs(local) > 0.4999 * one.size)
        away = np.einsum("ij,ij->i", normal, se3.apply(se3.inverse(one.T_base_object), SLANTED[None]) - local)
        assert (away > 0.0).all()
    assert cloud.points[cloud.labels == 0, 2] == pytest.approx(TABLE_Z, abs=1e-5)
    assert np.count_nonzero(cloud.labels == 0) > 10_000
    assert cloud.camera == pytest.approx(SLANTED)


def test_what_is_round_is_seen_as_a_cylinder() -> None:
    can = replace(box(size=TALL), size=np.array([0.06, 0.06, 0.1]), round=True)
    cloud = points_of((can,), LENS, T_CAMERA, TABLE_Z)
    local = se3.apply(se3.inverse(can.T_base_object), cloud.points[cloud.labels == 1])
    off = np.linalg.norm(local[:, :2], axis=1) / 0.03
    assert off.max() < 1.0 + 1e-3
    on_top = np.abs(local[:, 2] - 0.05) < 1e-4
    assert off[~on_top] == pytest.approx(1.0, abs=1e-3)
    assert 0.2 < on_top.mean() < 0.8


def test_what_nothing_else_is_known_of_has_the_shape_of_its_box() -> None:
    cup, can = replace(box(), kind=""), replace(box(), kind="can")
    assert [d.kind for d in with_points(Frame(1, (cup, can)), LENS, T_CAMERA, TABLE_Z).detections] == ["box", "can"]


def test_a_camera_below_the_table_or_within_a_box_sees_nothing_of_them() -> None:
    below = se3.make(np.eye(3), (0.27, -0.2, 0.2))
    assert not (points_of((), LENS, below, TABLE_Z).points[:, 2] < TABLE_Z - 1e-6).any()
    within = se3.make(T_CAMERA[:3, :3], box().p_base)
    assert not (points_of((box(),), LENS, within, TABLE_Z).labels == 1).any()
