# SPDX-License-Identifier: Apache-2.0
"""Objects by colour."""

from __future__ import annotations

import colorsys
import dataclasses

import cv2
import numpy as np
import pytest

from openarm_common.errors import Code
from openarm_perception.detection.detector import ColorDetector, ColorDetectorConfig, Detection2D, Detector, rank
from tests.refusals import refused

GREY = (176, 172, 165)
RED, BLUE = (200, 25, 25), (25, 60, 205)


def picture(*boxes: tuple[int, int, int, int, tuple[int, int, int]]):
    """A grey image with boxes (u, v, width, height, colour)."""
    image = np.full((120, 160, 3), GREY, np.uint8)
    for u, v, w, h, colour in boxes:
        image[v : v + h, u : u + w] = colour
    return image


@pytest.mark.requirement("A-60", "A-61", "B-04")
def test_class_score_and_box_centre(detector: Detector) -> None:
    """The centre of the box is its middle, not its corner; class, score and box are all in pixels."""
    (found,) = detector.detect(picture((40, 30, 21, 31, RED)))
    assert found.label == "red"
    assert 0.9 < found.score <= 1.0
    assert found.centre == (50.0, 45.0)
    assert found.size == (21, 31)
    assert found.origin == (40, 30)
    assert found.mask.all()
    assert not found.truncated


@pytest.mark.requirement("A-61")
def test_nothing_found_is_an_answer(detector: Detector) -> None:
    """An empty table gives an empty tuple."""
    assert detector.detect(picture()) == ()


@pytest.mark.requirement("A-60")
def test_largest_first_and_objects_of_one_colour_stay_apart(detector: Detector) -> None:
    """Two red boxes four pixels apart are two detections; a single row of pixels does not join them."""
    image = picture((20, 20, 20, 20, RED), (44, 20, 30, 30, RED), (100, 80, 40, 30, BLUE))
    image[30, 38:46] = RED
    found = detector.detect(image)
    assert [d.label for d in found] == ["blue", "red", "red"]
    assert [d.centre[0] for d in found[1:]] == pytest.approx([58.5, 29.5], abs=1.0)


def test_specks_and_small_patches_are_no_objects(detector: Detector) -> None:
    """Salt of 2 pixels goes by the clean-up, a patch below the area by its size."""
    rng = np.random.default_rng(0)
    image = picture((80, 60, 8, 8, RED))
    for u, v in rng.integers(2, 110, (60, 2)):
        image[v : v + 2, u] = RED
    assert detector.detect(image) == ()


def test_a_highlight_is_healed(detector: Detector) -> None:
    """A white spot inside is part of the object, but costs some score."""
    image = picture((40, 30, 30, 30, RED))
    cv2.circle(image, (52, 44), 5, (255, 250, 250), -1)
    (found,) = detector.detect(image)
    assert found.mask.all()
    assert 0.8 < found.score < 0.95


@pytest.mark.parametrize("hue_deg", [0, 5, 350, 356])
def test_red_wraps_around_zero(detector: Detector, hue_deg: float) -> None:
    """Red lies on both ends of the hue circle."""
    colour = tuple(round(255 * c) for c in colorsys.hsv_to_rgb(hue_deg / 360.0, 0.85, 0.8))
    (found,) = detector.detect(picture((40, 30, 20, 20, colour)))
    assert found.label == "red"


@pytest.mark.parametrize("value", [0.25, 0.5, 0.95])
@pytest.mark.requirement("B-18")
def test_every_palette_colour_has_one_name_at_any_brightness(detector: Detector, value: float) -> None:
    """The colours of the objects, among them the red of the cube and of the can, are distinguished."""
    hues = {"red": 0, "orange": 27, "yellow": 51, "green": 130, "blue": 225, "purple": 285}
    for label, hue in hues.items():
        colour = tuple(round(255 * c) for c in colorsys.hsv_to_rgb(hue / 360.0, 0.8, value))
        assert [d.label for d in detector.detect(picture((40, 30, 20, 20, colour)))] == [label]


def test_what_the_border_cuts_is_flagged(detector: Detector) -> None:
    """A cut object scores half."""
    (whole,) = detector.detect(picture((40, 30, 20, 20, RED)))
    (cut,) = detector.detect(picture((0, 30, 20, 20, RED)))
    assert cut.truncated
    assert cut.score == pytest.approx(0.5 * whole.score)


@pytest.mark.requirement("B-26")
def test_the_score_falls_with_area_fraction_and_saturation(detector: Detector) -> None:
    """A half-hidden shape and a washed-out colour are less certain; below the threshold they are dropped."""
    whole = detector.detect(picture((40, 30, 30, 30, RED)))[0].score
    notched = detector.detect(picture((40, 30, 30, 30, RED), (50, 30, 20, 20, GREY)))[0].score
    pale = detector.detect(picture((40, 30, 30, 30, (200, 100, 100))))[0].score
    assert notched < 0.75 * whole
    assert pale < 0.8 * whole
    strict = ColorDetector(detector.config.model_copy(update={"min_score": 0.9}))
    assert strict.detect(picture((40, 30, 30, 30, (200, 100, 100)))) == ()


@pytest.mark.parametrize("image", [np.zeros((10, 10), np.uint8), np.zeros((10, 10, 3), np.float32)])
@pytest.mark.requirement("B-28")
def test_another_image_is_refused(detector: Detector, image) -> None:
    """The shape and type are named."""
    assert refused(r"expected \(h, w, 3\) of uint8", detector.detect, image).code is Code.BAD_IMAGE


@pytest.mark.requirement("B-27")
def test_policies_rank_by_score_or_by_distance_from_the_centre() -> None:
    """The most certain, or the one nearest to the image centre."""
    mask = np.ones((9, 9), np.bool_)
    far = Detection2D("red", 0.9, (20.0, 20.0), (9, 9), mask, False)
    near = Detection2D("blue", 0.6, (85.0, 60.0), (9, 9), mask, False)
    other = Detection2D("red", 0.7, (120.0, 60.0), (9, 9), mask, False)
    everything = (near, other, far)
    assert rank(everything, "score", (160, 120)) == (far, other, near)
    assert rank(everything, "centre", (160, 120)) == (near, other, far)


@pytest.mark.requirement("B-03")
def test_a_detection_in_the_image_holds_no_position_in_space() -> None:
    """Pixels and metres are different types: a 2-D detection has no depth, no frame, nothing to take for a position.

    A detector of depth hands on the cluster that it segmented, whole.
    """
    names = {f.name for f in dataclasses.fields(Detection2D)}
    assert names == {"name", "color", "kind", "score", "centre", "size", "mask", "truncated", "cluster"}


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"hue_deg": (10, 400)}, "0..360"),
        ({"label": "can"}, "'can' names a shape; expected the name of a colour"),
        ({"saturation": (0.9, 0.2)}, "from < to"),
        ({"label": ""}, "at least 1 character"),
    ],
)
def test_wrong_colours_are_refused(change: dict[str, object], fault: str) -> None:
    """A range that can't be is named."""
    color = {"label": "red", "hue_deg": (345, 12), **change}
    with pytest.raises(ValueError, match=fault):
        ColorDetectorConfig.model_validate({"classes": [color]})


def test_labels_must_be_unique() -> None:
    """Two colours of one name can't be distinguished by who asks for it."""
    color = {"label": "red", "hue_deg": (345, 12)}
    with pytest.raises(ValueError, match="unique"):
        ColorDetectorConfig.model_validate({"classes": [color, color]})
