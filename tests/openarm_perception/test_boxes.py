# SPDX-License-Identifier: Apache-2.0
"""Letterbox and decoding: boxes find back into the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from openarm_perception.detection.boxes import Letterbox, blob, overlap
from openarm_perception.detection.layouts import decode

SIZES = ((320, 256), (640, 480), (640, 640), (320, 320))


@settings(max_examples=80)
@given(
    width=st.integers(8, 2000),
    height=st.integers(8, 2000),
    size=st.sampled_from(SIZES),
    shares=st.tuples(*[st.floats(0.0, 1.0)] * 4),
)
@pytest.mark.requirement("B-38")
def test_boxes_come_back_within_a_pixel_at_every_aspect_ratio(width, height, size, shares) -> None:
    letterbox = Letterbox.fit((width, height), size)
    x, y = sorted((shares[0] * width, shares[1] * width)), sorted((shares[2] * height, shares[3] * height))
    boxes = np.array([[x[0], y[0], x[1], y[1]], [0.0, 0.0, width, height]])
    inside = boxes * (*letterbox.scale, *letterbox.scale) + (letterbox.left, letterbox.top) * 2
    assert (inside >= -1e-9).all()
    assert (inside <= np.array([*size, *size]) + 1e-9).all()
    assert np.abs(letterbox.back(inside) - boxes).max() < 1e-6
    # the image keeps its proportions but for the rounding to whole pixels
    assert max(letterbox.inner[0] / size[0], letterbox.inner[1] / size[1]) == pytest.approx(1.0)
    share = min(size[0] / width, size[1] / height)
    assert abs(letterbox.inner[0] - width * share) <= 1.0
    assert abs(letterbox.inner[1] - height * share) <= 1.0


@pytest.mark.parametrize("image", [(640, 480), (480, 640), (1920, 1080), (320, 240), (101, 640), (640, 37), (17, 23)])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.requirement("B-38")
def test_what_is_seen_in_the_input_is_where_the_image_has_it(image, size) -> None:
    """A bright rectangle is drawn, placed, found in the input and mapped back: within a pixel."""
    width, height = image
    rgb = np.zeros((height, width, 3), np.uint8)
    left, top, right, bottom = (
        width // 4,
        height // 4,
        max(width // 2, width // 4 + 4),
        max(height * 2 // 3, height // 4 + 4),
    )
    rgb[top:bottom, left:right] = 255
    letterbox = Letterbox.fit(image, size)
    placed = letterbox.place(rgb)
    assert placed.shape == (size[1], size[0], 3)
    rows, columns = (np.nonzero((placed[..., 0] >= 128).any(axis=axis))[0] for axis in (1, 0))
    box = np.array([[columns[0], rows[0], columns[-1] + 1, rows[-1] + 1]], np.float64)
    slack = max(
        1.0, 0.5 / letterbox.scale[0], 0.5 / letterbox.scale[1]
    )  # a pixel of the image or half a one of the input
    assert np.abs(letterbox.back(box) - [left, top, right, bottom]).max() <= slack


def output(*rows: tuple[float, ...]) -> np.ndarray:
    """A network's output: rows of cx, cy, w, h, score, score."""
    return np.array(rows, np.float32).T


@pytest.mark.requirement("N-15")
def test_the_best_box_of_a_thing_is_kept_and_neighbours_stay() -> None:
    found = decode(
        output(
            (50, 50, 20, 20, 0.6, 0.1),  # weaker, same thing
            (51, 50, 20, 20, 0.9, 0.1),
            (75, 50, 20, 20, 0.7, 0.2),  # next to it
            (51, 51, 20, 20, 0.1, 0.8),  # same place, other class: overlaps by more than half way
            (10, 10, 5, 5, 0.3, 0.2),  # not certain enough
        ),
        0.5,
        0.6,
    )
    assert found.classes.tolist() == [0, 0]
    assert found.scores == pytest.approx([0.9, 0.7])
    assert found.boxes[0].tolist() == [41, 40, 61, 60]


def test_many_candidates_are_limited_and_none_give_none() -> None:
    rng = np.random.default_rng(0)
    many = np.vstack([rng.uniform(0, 640, (2, 6300)), np.full((2, 6300), 5.0), rng.random((3, 6300))]).astype(
        np.float32
    )
    assert len(decode(many, 0.5, 0.6, limit=30).scores) == 30
    assert decode(many, 0.9999999, 0.6).boxes.shape == (0, 4)


def test_overlap_of_boxes() -> None:
    box = np.array([0.0, 0.0, 10.0, 10.0])
    others = np.array([[0.0, 0.0, 10.0, 10.0], [5.0, 0.0, 15.0, 10.0], [20.0, 20.0, 30.0, 30.0], [3.0, 3.0, 3.0, 3.0]])
    assert overlap(box, others) == pytest.approx([1.0, 1.0 / 3.0, 0.0, 0.0])


def test_the_input_is_red_green_blue_from_0_to_1() -> None:
    rgb = np.zeros((4, 6, 3), np.uint8)
    rgb[1, 2] = (255, 128, 0)
    image = blob(rgb)
    assert image.shape == (1, 3, 4, 6)
    assert image[0, :, 1, 2] == pytest.approx([1.0, 128 / 255, 0.0])
