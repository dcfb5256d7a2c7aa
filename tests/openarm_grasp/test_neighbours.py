# SPDX-License-Identifier: Apache-2.0
"""Boxes that a plan keeps clear of: of a heap, what its points need."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.labelled_cloud import LabelledCloud
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Sighting
from openarm_grasp.planning.candidates import Box, obstacle_boxes, target_box
from openarm_grasp.planning.neighbours import cornered, neighbours

CONFIG = GraspConfig()
TABLE = 0.4


def lattice(low, high, step=0.003):
    axes = [np.arange(a, b + 1e-9, step) for a, b in zip(low, high, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def detection(low, high, kind="", yaw=0.0):
    low, high = np.array(low), np.array(high)
    return Detection("anything", 0.9, se3.make(se3.rot_z(yaw), 0.5 * (low + high)), high - low, kind=kind)


def holds(boxes, points, slack=0.0):
    inside = np.zeros(len(points), bool)
    for box in boxes:
        local = se3.apply(se3.inverse(box.T_frame_box), points)
        inside |= (np.abs(local) <= 0.5 * box.size + slack).all(axis=1)
    return inside


# an angle, whose box is mostly empty, and a bar that lies in its corner
LEGS = (((0.2, 0.0, TABLE), (0.22, 0.12, TABLE + 0.03)), ((0.2, 0.0, TABLE), (0.32, 0.02, TABLE + 0.03)))
ANGLE = detection((0.2, 0.0, TABLE), (0.32, 0.12, TABLE + 0.03))
BAR = detection((0.245, 0.045, TABLE), (0.315, 0.07, TABLE + 0.03))


def sighting(target, other, *clouds):
    points = np.concatenate([np.empty((0, 3)), *clouds]).astype(np.float32)
    labels = np.full(len(points), 2, np.uint32)
    seen = (LabelledCloud(points, labels, np.array([0.2, 0.0, 1.2])),) if len(points) else ()
    return Sighting(target, (other,), 0, seen)


@pytest.mark.requirement("R-17")
def test_what_lies_in_the_corner_of_an_angle_is_not_in_collision_with_it():
    legs = [lattice(*leg) for leg in LEGS]
    held = target_box(BAR, CONFIG)
    boxes = neighbours(sighting(BAR, ANGLE, *legs), (held,), CONFIG)
    bar = lattice((0.245, 0.045, TABLE), (0.315, 0.07, TABLE + 0.12))  # lifted straight up
    assert not holds(boxes, bar).any()
    assert holds(boxes, np.concatenate(legs), slack=0.005).all()
    assert holds(obstacle_boxes((ANGLE,), CONFIG), bar).any()


@pytest.mark.requirement("R-17")
def test_a_prism_keeps_its_box_where_it_is_not_touched():
    prism = detection((0.2, 0.0, TABLE), (0.25, 0.05, TABLE + 0.05), kind="box")
    far = target_box(detection((0.4, 0.0, TABLE), (0.45, 0.05, TABLE + 0.05)), CONFIG)
    (box,) = neighbours(sighting(BAR, prism, lattice((0.2, 0.0, TABLE), (0.25, 0.05, TABLE + 0.05))), (far,), CONFIG)
    (whole,) = obstacle_boxes((prism,), CONFIG)
    assert box.id == whole.id
    np.testing.assert_allclose(box.size, whole.size)


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize("yaw", [0.0, 0.4, 2.0])
def test_no_box_reaches_into_what_touches_it(yaw):
    target = detection((0.25, 0.0, TABLE), (0.30, 0.05, TABLE + 0.05), yaw=yaw)
    beside = detection((0.295, 0.0, TABLE), (0.35, 0.05, TABLE + 0.05), kind="box")
    held = target_box(target, CONFIG)
    boxes = neighbours(sighting(target, beside), (held,), CONFIG)
    inside = se3.apply(held.T_frame_box, lattice(-0.5 * held.size, 0.5 * held.size))
    assert not holds(boxes, inside).any()
    assert holds(boxes, np.array([[0.34, 0.025, TABLE + 0.02]])).all()


@pytest.mark.requirement("R-17")
def test_what_lies_on_an_object_still_stops_it_from_being_lifted():
    target = detection((0.25, 0.0, TABLE), (0.30, 0.05, TABLE + 0.05), kind="box")
    over = detection((0.24, 0.0, TABLE + 0.05), (0.32, 0.05, TABLE + 0.08), kind="box")
    boxes = neighbours(sighting(target, over), (target_box(target, CONFIG),), CONFIG)
    assert holds(boxes, np.array([[0.275, 0.025, TABLE + 0.07]])).all()


def test_a_box_inside_of_what_is_held_goes():
    small = detection((0.26, 0.01, TABLE), (0.28, 0.03, TABLE + 0.02), kind="box")
    held = Box("target/x", se3.make(p=(0.27, 0.02, TABLE + 0.03)), np.array([0.1, 0.1, 0.08]))
    assert neighbours(sighting(BAR, small), (held,), CONFIG) == ()


@pytest.mark.requirement("R-17")
@pytest.mark.parametrize("reach", [0.008, 0.030])
def test_what_reaches_over_an_object_a_little_does_not_stop_its_lift(reach):
    low, high = (0.245, 0.045, TABLE), (0.315, 0.07, TABLE + 0.03)
    edge = 0.07 - reach
    over = detection((0.245, edge, TABLE + 0.036), (0.315, edge + 0.05, TABLE + 0.08))
    points = lattice((0.245, edge, TABLE + 0.08), (0.315, edge + 0.05, TABLE + 0.08))
    under = detection(low, high)
    boxes = neighbours(sighting(under, over, points), (target_box(under, CONFIG),), CONFIG)
    lifted = lattice(low, (*high[:2], TABLE + 0.12))
    assert holds(boxes, lifted).any() == (reach > 0.015)
    assert holds(boxes, points[points[:, 1] > 0.076], slack=0.005).all()  # outside of it everything stays


def test_what_reaches_inwards_may_be_several_things():
    legs, bar = np.concatenate([lattice(*leg) for leg in LEGS]), lattice((0.245, 0.045, TABLE), (0.315, 0.07, TABLE))
    for target, points, expected in ((ANGLE, legs, True), (BAR, bar, False)):
        cloud = LabelledCloud(points.astype(np.float32), np.ones(len(points), np.uint32), np.array([0.2, 0.0, 1.2]))
        assert cornered(Sighting(target, (), 0, (cloud,))) is expected
    assert not cornered(Sighting(ANGLE, (), 0))
    line = LabelledCloud(bar[:20].astype(np.float32), np.ones(20, np.uint32), np.array([0.2, 0.0, 1.2]))
    assert not cornered(Sighting(BAR, (), 0, (line,)))
