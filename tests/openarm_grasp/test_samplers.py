# SPDX-License-Identifier: Apache-2.0
"""Samplers: which one finds the grasps, what each needs, and that another one needs no change of code."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.planning.candidates import GraspCandidate, propose
from openarm_grasp.planning.retries import FailedGrasp
from openarm_grasp.sampling.samplers import Sampling, make_sampler, refine
from openarm_grasp.sampling.slabs import slabs
from openarm_grasp.sampling.surface import View, fuse
from tests.openarm_grasp.clouds import SLANTED, TABLE_Z, box, hand, seen, surface_of
from tests.refusals import refuses

CONFIG = GraspConfig()
PARTS = RobotDescription.load("openarm_v1").hand("right").parts


def detected(size, *, measured=True) -> Detection:
    T = se3.make(p=(0.27, -0.2, TABLE_Z + 0.5 * size[2]))
    return Detection("thing", 0.9, T, np.array(size), measured=measured)


def asked(parts, size, *, measured=True) -> Sampling:
    target = detected(size, measured=measured)
    return Sampling(target, CONFIG, PARTS, surface=surface_of(parts), shape=hand())


class OverItsCentroid:
    """A sampler of another package: one upright grasp over the centroid of the cloud, as a network might return it."""

    def candidates(self, asked: Sampling) -> tuple[GraspCandidate, ...]:
        """As of `GraspSampler`."""
        surface = asked.surface
        assert surface is not None
        T = se3.make(se3.rot_x(np.pi), [*surface.centroid[:2], surface.top - 0.01])
        back = np.array([0.0, 0.0, asked.config.approach.pregrasp_distance])
        return (GraspCandidate("net/tilt0", T, back, back, 0.04, 0.0, 1.0, {"net": 1.0}, apertures=(0.02, 0.06)),)


class NoSampler:
    """Has no method candidates."""


def test_a_box_that_fits_keeps_its_exact_treatment():
    question = asked([box((0.05, 0.06, 0.05))], (0.05, 0.06, 0.05))
    question = replace(question, target=replace(question.target, kind="box"))
    found = make_sampler("auto").candidates(question)
    exact = propose(question.target, CONFIG, PARTS)
    assert [c.id for c in found] == [c.id for c in exact]
    assert all(c.apertures is None and c.held == () for c in found)


def test_a_box_that_a_hand_has_met_beside_its_faces_is_grasped_on_its_cloud():
    question = asked([box((0.05, 0.06, 0.05))], (0.05, 0.06, 0.05))
    question = replace(question, target=replace(question.target, kind="box"))
    first = make_sampler("auto").candidates(question)[0]
    met = FailedGrasp.of(Code.HAND_COLLISION, "right", first, question.target)
    found = make_sampler("auto").candidates(replace(question, failed=(met,)))
    assert all(c.apertures is not None for c in found)
    missed = replace(met, code=Code.GRASP_MISSED)
    assert make_sampler("auto").candidates(replace(question, failed=(missed,)))[0].apertures is None


@pytest.mark.parametrize(("size", "measured"), [((0.22, 0.12, 0.05), True), ((0.05, 0.06, 0.05), False)])
def test_what_is_no_box_that_fits_is_grasped_on_its_cloud(size, measured):
    t = [box((0.22, 0.03, 0.05)), box((0.03, 0.12, 0.05))]
    found = make_sampler("auto").candidates(asked(t, size, measured=measured))
    assert len({c.id for c in found}) == len(found) > 10
    assert [c.score for c in found] == sorted((c.score for c in found), reverse=True)
    for c in found:
        assert c.apertures is not None
        assert c.apertures[0] <= c.width <= c.apertures[1]
        assert sum(c.parts.values()) == pytest.approx(c.score)
        assert np.linalg.norm(c.approach_offset) == pytest.approx(CONFIG.approach.pregrasp_distance)
        assert c.approach_offset @ c.T_base_tcp[:3, 2] < 0.0
        assert c.patch_area > 0.0
        assert c.id.rpartition("/tilt")[2] == f"{np.degrees(c.tilt):.0f}"


def test_without_a_cloud_auto_is_boxes_and_cloud_says_what_is_missing():
    question = replace(asked([box((0.05, 0.05, 0.05))], (0.05, 0.05, 0.05)), surface=None)
    assert [c.id for c in make_sampler("auto").candidates(question)] == [
        c.id for c in make_sampler("boxes").candidates(question)
    ]
    with refuses(Code.NOT_READY, "the cloud of the object is not known"):
        make_sampler("cloud").candidates(question)


def test_what_is_too_wide_is_refused_with_its_measures():
    with refuses(Code.TOO_WIDE, r"'thing' \(\d+ × \d+ × \d+ mm\) has no two opposite sides"):
        make_sampler("auto").candidates(asked([box((0.12, 0.12, 0.06))], (0.12, 0.12, 0.06)))


def test_what_stands_too_close_is_refused_with_counts():
    walls = [box((0.02, 0.10, 0.12), x=0.27 + s * 0.042) for s in (1, -1)]
    walls += [box((0.10, 0.02, 0.12), y=-0.2 + s * 0.042) for s in (1, -1)]
    surface = surface_of([box((0.04, 0.04, 0.05))], others=walls)
    question = replace(asked([box((0.04, 0.04, 0.05))], (0.04, 0.04, 0.05)), surface=surface)
    with refuses(Code.IN_COLLISION, r"none of .* poses of the hand is possible: .*hand in something"):
        make_sampler("cloud").candidates(question)


def test_a_sampler_of_another_package_needs_no_change_of_code():
    sampler = make_sampler(f"{__name__}:OverItsCentroid")
    (only,) = sampler.candidates(asked([box((0.04, 0.04, 0.05))], (0.04, 0.04, 0.05)))
    assert only.T_base_tcp[:2, 3] == pytest.approx([0.27, -0.2], abs=0.002)
    assert only.apertures == (0.02, 0.06)


@pytest.mark.parametrize("name", ["nothing", "no.such.module:Class", f"{__name__}:NoSampler", f"{__name__}:", ""])
def test_a_sampler_that_does_not_exist_is_refused_with_the_valid_ones(name):
    with refuses(Code.CONFIG_INVALID, r"grasp\.sampler .*valid: boxes, cloud, auto, or package"):
        make_sampler(name)


def test_a_second_look_ranks_again_and_moves_the_grasp_to_where_the_object_is():
    first = asked([box((0.04, 0.08, 0.05))], (0.04, 0.08, 0.05), measured=False)
    before = make_sampler("cloud").candidates(first)[0]
    parts = [box((0.04, 0.08, 0.05), x=0.278)]
    near = np.array([0.27, -0.2, 0.65])
    surface = fuse([View(SLANTED, seen(parts, SLANTED)), View(near, seen(parts, near))], TABLE_Z)
    after = refine(before, replace(first, surface=surface))
    assert after
    assert after[0].T_base_tcp[0, 3] == pytest.approx(before.T_base_tcp[0, 3] + 0.008, abs=0.003)
    turned = se3.angle_between(after[0].T_base_tcp[:3, :3], before.T_base_tcp[:3, :3])
    assert min(turned, np.pi - turned) < 0.2


def test_held_slabs_enclose_the_cloud_with_less_volume_than_one_box():
    surface = surface_of([box((0.16, 0.03, 0.03), yaw=0.6), box((0.03, 0.16, 0.03), yaw=0.6)])
    boxes = slabs("cross", surface.solid, surface.step)
    assert 1 < len(boxes) <= 8
    left = np.ones(len(surface.solid), bool)
    for one in boxes:
        local = np.abs(se3.apply(se3.inverse(one.T_frame_box), surface.solid))
        left &= (local > 0.5 * one.size + 1e-9).any(axis=1)
    assert not left.any()
    whole = slabs("cross", surface.solid, surface.step, most=1)[0]
    assert sum(float(b.size.prod()) for b in boxes) < 0.6 * float(whole.size.prod())


def test_held_slabs_end_above_the_table():
    surface = surface_of([box((0.05, 0.05, 0.05))])
    boxes = slabs("box", surface.solid, surface.step, gap=0.003)
    assert min(float(b.T_frame_box[2, 3] - b.size[2] / 2) for b in boxes) == pytest.approx(TABLE_Z + 0.003)
