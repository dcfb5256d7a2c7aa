# SPDX-License-Identifier: Apache-2.0
"""Centres of circles by their grey values."""

from __future__ import annotations

from functools import cache

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.board.detect import detect
from openarm_calibration.board.detect_circles import refined
from openarm_common import se3
from openarm_common.errors import OpenArmError

BOARD = CircleGrid()
PLANE = BOARD.points[:, :2]
#: 0.71 pixels a millimetre, turned by 20 degrees.
TURN = se3.rot_z(np.radians(20.0))[:2, :2]
H = np.eye(3)
H[:2, :2], H[:2, 2] = 710.0 * TURN, (160.3, 119.6)
TRUE = PLANE @ H[:2, :2].T + H[:2, 2]


@cache
def sharp() -> NDArray[np.float64]:
    """The board, 8x8 samples a pixel."""
    image = np.full((240, 320), 190.0)
    for centre in TRUE:
        low = np.round(centre).astype(int) - 9
        v, u = np.mgrid[0 : 18 * 8, 0 : 18 * 8]
        offset = (np.stack([u, v], axis=-1) + 0.5) / 8.0 - 0.5 + low - centre
        light = np.where((offset**2).sum(axis=-1) < (710.0 * BOARD.radius) ** 2, 30.0, 190.0)
        image[low[1] : low[1] + 18, low[0] : low[0] + 18] = light.reshape(18, 8, 18, 8).mean(axis=(1, 3))
    return image


def picture(blur: float, slope: float, noise: float = 0.0) -> NDArray[np.uint8]:
    """Blurred, and lit unevenly by `slope` grey values a pixel."""
    image = cv2.GaussianBlur(sharp(), (0, 0), blur) if blur else sharp()
    image = image + slope * (np.arange(320) - 160.0)[None, :]
    return np.clip(image + np.random.default_rng(0).normal(0.0, noise, image.shape), 0, 255).round().astype(np.uint8)


def test_a_start_half_a_pixel_off_ends_within_a_hundredth() -> None:
    for blur in (0.0, 1.0):
        found, sure = refined(picture(blur, 0.0), TRUE + np.array([0.4, -0.3]), PLANE, BOARD.radius, H)
        assert sure.all()
        assert np.sqrt(np.mean((found - TRUE) ** 2)) < 0.01


def test_uneven_light_does_not_pull_the_centres() -> None:
    """0.2 grey values a pixel: a fifth of the contrast over the board."""
    found, _ = refined(picture(0.7, 0.2), TRUE, PLANE, BOARD.radius, H)
    assert np.abs((found - TRUE).mean(axis=0)).max() < 0.005


def test_a_circle_at_the_edge_of_the_image_keeps_its_start() -> None:
    image = picture(0.0, 0.0)
    left = int(TRUE[0, 0]) - 8
    start = TRUE - (left, 0.0) + 0.25
    shift = np.eye(3)
    shift[0, 2] = -left
    found, sure = refined(np.ascontiguousarray(image[:, left:]), start, PLANE, BOARD.radius, shift @ H)
    assert np.array_equal(found[0], start[0])
    assert not sure[0]


def test_marks_that_something_covers_or_comes_near_to_are_left_out() -> None:
    """A sticker over half a circle and a cable next to another; what is reported is right to 0.05 px."""
    image = picture(0.5, 0.0, noise=1.0)
    u, v = np.round(TRUE[20]).astype(int)
    image[v - 4 : v + 5, u - 4 : u + 1] = 190
    u, v = np.round(TRUE[7]).astype(int)
    image[v - 3 : v + 4, u + 7] = 60
    detection = detect(BOARD, image)
    assert list(np.setdiff1d(np.arange(44), detection.ids)) == [7, 20]
    assert np.abs(detection.pixels - TRUE[detection.ids]).max() < 0.05


@pytest.mark.parametrize("margin", [1.4, 1.6])
def test_circles_at_the_edge_of_the_paper_are_found_by_their_other_sides(margin: float) -> None:
    """Of the white around a circle, radii from its centre to a dark table; only corners may be left out."""
    image = picture(0.5, 0.0, noise=1.0)
    places = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1)
    on_board = (places - H[:2, 2]) @ np.linalg.inv(H[:2, :2]).T
    image[(np.abs(on_board) > np.abs(PLANE).max(axis=0) + margin * BOARD.radius).any(axis=-1)] = 50
    detection = detect(BOARD, image)
    assert len(detection.ids) >= 40
    assert np.abs(detection.pixels - TRUE[detection.ids]).max() < 0.06


def test_a_board_behind_something_is_refused_with_the_number_of_whole_circles() -> None:
    """A frame around each circle: blobs are found, but their surroundings are not white."""
    image = picture(0.0, 0.0)
    for centre in TRUE[:20]:
        u, v = np.round(centre).astype(int)
        cv2.rectangle(image, (u - 8, v - 8), (u + 8, v + 8), 60)
    with pytest.raises(OpenArmError, match=r"only 2\d of 44 circles .* are whole, with white around them"):
        detect(BOARD, image)
