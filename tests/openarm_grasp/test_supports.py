# SPDX-License-Identifier: Apache-2.0
"""Objects that stand on others: where they may be put, what a plan keeps clear of, and how a request says so."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_bringup.cli import _place_on
from openarm_common import se3
from openarm_common.detection import Detection
from openarm_common.errors import Code
from openarm_common.labelled_cloud import LabelledCloud
from openarm_common.robot.description import RobotDescription
from openarm_grasp.config import GraspConfig
from openarm_grasp.perception.detections import Frame, Ids, Sighting, find, on_table
from openarm_grasp.perception.sightings import standing_at, surface_of
from openarm_grasp.planning.candidates import propose, target_box
from openarm_grasp.planning.neighbours import neighbours, under
from openarm_grasp.planning.place import free_spots, place_targets, spots_on
from openarm_grasp.requests.request import GraspRequest
from tests.refusals import refused

CONFIG, TABLE = GraspConfig(), 0.4
HAND = RobotDescription.load().hand(RobotDescription.load().arm_names[0]).parts


def thing(name: str, foot, size, yaw: float = 0.0, kind: str = "box") -> Detection:
    """A box whose footprint centre (3,) and edges (3,) are these."""
    T = se3.make(se3.rot_z(yaw), np.add(foot, (0.0, 0.0, 0.5 * size[2])))
    return Detection("", 0.9, T, np.array(size), kind=kind, color=name)


def of(target: Detection, *others: Detection, points=None) -> Sighting:
    """A sighting whose cloud has these points of others."""
    clouds = ()
    if points is not None:
        labels = np.full(len(points), 2, np.uint32)
        clouds = (LabelledCloud(np.asarray(points, np.float32), labels, np.array([0.5, 0.0, 1.1])),)
    return Sighting(target, others, 0, clouds)


def top_points(low, high, z: float) -> np.ndarray:
    """Points every 4 mm of a level rectangle."""
    x, y = (np.arange(a, b, 0.004) for a, b in zip(low, high, strict=True))
    return np.stack([*np.meshgrid(x, y), np.full((len(y), len(x)), z)], axis=-1).reshape(-1, 3)


CUBE = thing("red", (0.2, -0.2, TABLE), (0.045, 0.045, 0.045))
SMALL = thing("blue", (0.3, 0.1, TABLE), (0.03, 0.02, 0.1))
FULL = thing("green", (0.3, 0.1, TABLE + 0.12), (0.14, 0.16, 0.05), yaw=0.6)
BOX = thing("blue", (0.3, 0.1, TABLE), (0.15, 0.18, 0.12), yaw=0.6)


def test_a_spot_on_a_box_is_within_its_outline_at_the_height_of_its_top():
    spots = spots_on("blue box", of(CUBE, BOX), CONFIG.place)
    assert len(spots) > 3
    for spot in spots:
        local = se3.rot_z(-0.6) @ (spot - (0.3, 0.1, 0.0))
        assert (np.abs(local[:2]) <= (0.075 - 0.0225 + 1e-9, 0.09 - 0.0225 + 1e-9)).all()
        assert spot[2] == pytest.approx(TABLE + 0.12)
    ways = place_targets(CUBE, propose(CUBE, CONFIG, HAND)[0], spots[:1], CONFIG)
    placed = ways[0].T_base_tcp @ se3.inverse(propose(CUBE, CONFIG, HAND)[0].T_base_tcp) @ CUBE.T_base_object
    assert placed[2, 3] == pytest.approx(TABLE + 0.12 + 0.0225 + CONFIG.place.release_height)
    assert ways[0].position == pytest.approx(spots[0])


def test_spots_keep_clear_of_what_stands_there_already():
    taken = thing("green", (0.3, 0.1, TABLE + 0.12), (0.05, 0.05, 0.05))
    spots = spots_on("blue", of(CUBE, BOX, taken), CONFIG.place)
    assert min(np.linalg.norm(np.maximum(np.abs(s[:2] - (0.3, 0.1)) - 0.025, 0.0)) for s in spots) >= 0.0225


def test_the_surface_of_a_tray_is_its_bottom_and_that_of_a_box_its_top():
    tray = thing("green", (0.3, 0.1, TABLE), (0.2, 0.24, 0.04))
    bottom = top_points((0.205, -0.015), (0.395, 0.215), TABLE + 0.006)
    rim = np.concatenate(
        [top_points((0.2, -0.02), (0.4, -0.012), TABLE + 0.04), top_points((0.2, 0.212), (0.4, 0.22), TABLE + 0.04)]
    )
    seen = of(CUBE, tray, points=np.concatenate([bottom, rim]))
    assert surface_of(tray, seen) == pytest.approx(TABLE + 0.006, abs=1e-3)
    assert surface_of(BOX, of(CUBE, BOX)) == BOX.top
    assert {round(float(spot[2]), 3) for spot in spots_on("green", seen, CONFIG.place)} == {0.406}
    # a plan to put something into it keeps clear of its rim, and not of what is above its bottom
    boxes = under(
        neighbours(seen, (), CONFIG),
        place_targets(CUBE, propose(CUBE, CONFIG, HAND)[0], [np.array([0.3, 0.1, 0.406])], CONFIG),
    )
    above = np.array([[0.3, 0.1, TABLE + 0.008], [0.3, 0.1, TABLE + 0.03]])
    inside = [np.abs(se3.apply(se3.inverse(b.T_frame_box), above)) <= 0.5 * b.size for b in boxes]
    assert not np.any([i.all(axis=1) for i in inside])
    edge = np.array([[0.3, -0.016, TABLE + 0.03]])
    assert any((np.abs(se3.apply(se3.inverse(b.T_frame_box), edge)) <= 0.5 * b.size).all() for b in boxes)


@pytest.mark.parametrize(
    ("others", "name", "code", "words"),
    [
        ((BOX,), "green box", Code.UNKNOWN_OBJECT, r"no 'green box' to place 'red' on or in; in view: blue \(box\)"),
        ((), "tray", Code.NOTHING_DETECTED, "in view: nothing"),
        ((SMALL,), "blue", Code.PLACE_FAILED, "does not fit on 'blue', which is 30 mm"),
        ((BOX, FULL), "blue", Code.PLACE_FAILED, "no free spot on 'blue': 1 objects stand there"),
    ],
)  # fmt: skip
def test_a_place_that_is_none_is_refused_with_what_is_in_view(others, name: str, code: Code, words: str):
    assert refused(words, spots_on, name, of(CUBE, *others), CONFIG.place).code is code


def test_what_carries_an_object_is_another_one_and_not_beside_it():
    cube = thing("red", (0.3, 0.1, TABLE + 0.12), (0.045, 0.045, 0.045))
    next_to = thing("green", (0.4, 0.25, TABLE), (0.05, 0.05, 0.3))
    frames = [Ids().given(Frame(k, (cube, BOX, next_to))) for k in range(3)]
    seen = find(frames, "red", CONFIG.detect)
    assert {one.label for one in seen.others} == {"blue", "green"}
    assert [one.label for one in seen.beside] == ["green"]
    assert on_table(cube, TABLE) is cube  # its bottom is believed
    boxes = neighbours(seen, (target_box(cube, CONFIG),), CONFIG)
    carrier = next(box for box in boxes if "blue" in box.id)
    top = carrier.T_frame_box[2, 3] + 0.5 * carrier.size[2]
    assert TABLE + 0.11 < top < TABLE + 0.12  # it is there, and what is lifted off it does not begin in it


def test_an_object_that_is_put_elsewhere_stands_there_as_high_as_that_is():
    cube = thing("red", (0.3, 0.1, TABLE + 0.12), (0.045, 0.045, 0.045))
    assert standing_at(cube, (0.2, 0.0, TABLE)).bottom == pytest.approx(TABLE)
    assert standing_at(cube, (0.2, 0.0)).bottom == pytest.approx(TABLE + 0.12)


def test_spots_that_something_hides_come_last():
    seen = top_points((0.16, -0.42), (0.36, -0.24), TABLE)
    shoulders = {"right": (0.0, -0.1), "left": (0.0, 0.1)}
    spots = free_spots("right", CUBE, (), CONFIG, shoulders, seen=seen)
    assert all(spot[1] < -0.2 for spot in spots)
    assert any(spot[1] > -0.2 for spot in free_spots("right", CUBE, (), CONFIG, shoulders, every=True))


@pytest.mark.parametrize(
    ("words", "selection", "label", "place_on"),
    [
        ("red on:blue box", "", "red", "blue box"),
        ("red cube left of the can in: tray", "", "red cube left of the can", "tray"),
        ("on:tray", "", "", "tray"),
        ("pylon: red", "", "pylon: red", ""),
        ("red", "", "red", ""),
        ("Easiest red IN:tray", "easiest", "red", "tray"),
        ("the easiest", "easiest", "", ""),
        ("the easiestred", "", "the easiestred", ""),
    ],
)
def test_words_of_a_user_become_fields(words: str, selection: str, label: str, place_on: str):
    request = GraspRequest.of(words, arm="left")
    assert request == GraspRequest(label, "left", selection=selection, place_on=place_on)


def test_a_selection_that_does_not_exist_is_refused():
    assert (
        "easiest, " in refused("'ugliest' does not exist", GraspRequest("red", selection="ugliest").check, ()).message
    )


def test_two_places_are_refused():
    both = GraspRequest("red", place=(0.3, 0.1), place_on="tray")
    assert refused("two places: on:tray and", both.check, ("left",)).code is Code.INVALID_ARGUMENT


def test_the_command_line_takes_a_place_in_words():
    asked = ["pick", "red", "blue", "--place", "on:blue box", "--place", "in:tray", "--place", "0.3", "0.1", "0"]
    expected = ["pick", "red", "blue", "--place-on", "blue box", "--place-on", "tray", "--place", "0.3", "0.1", "0"]
    assert _place_on(asked) == expected
