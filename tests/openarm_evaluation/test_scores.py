# SPDX-License-Identifier: Apache-2.0
"""Figures of detectors, on cases that can be counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_evaluation.detector.training.scores import score
from openarm_perception.detection.boxes import Candidates


def candidates(*rows: tuple[int, float, float, float]) -> Candidates:
    """Boxes of 10 pixels at (u, v): class, score, u, v."""
    return Candidates(
        np.array([r[0] for r in rows], np.int64),
        np.array([r[1] for r in rows], np.float64),
        np.array([(r[2], r[3], r[2] + 10, r[3] + 10) for r in rows], np.float64).reshape(-1, 4),
    )


def truth(*rows: tuple[int, float, float]):
    found = candidates(*((kind, 1.0, u, v) for kind, u, v in rows))
    return found.classes, found.boxes


def test_all_right_is_one() -> None:
    result = score([candidates((0, 0.9, 0, 0), (1, 0.8, 50, 50))], [truth((0, 0, 0), (1, 50, 50))], 2)
    assert (result.map50, result.map, result.any50) == (1.0, 1.0, 1.0)
    assert (result.precision, result.recall) == (1.0, 1.0)
    assert result.centre_median_px == 0.0
    assert result.confusion.tolist() == [[1, 0, 0], [0, 1, 0], [0, 0, 0]]


def test_a_false_box_above_the_right_one_halves_the_precision() -> None:
    result = score([candidates((0, 0.9, 80, 80), (0, 0.8, 0, 0))], [truth((0, 0, 0))], 1)
    assert result.map50 == pytest.approx(0.5)
    assert (result.precision, result.recall) == (0.5, 1.0)


def test_one_of_two_found_is_half() -> None:
    result = score([candidates((0, 0.9, 0, 0))], [truth((0, 0, 0), (0, 50, 50))], 1)
    assert result.map50 == pytest.approx(51 / 101)
    assert result.confusion.tolist() == [[1, 1], [0, 0]]


def test_the_centre_error_is_that_of_right_boxes_and_overlap_counts() -> None:
    """3 pixels aside: overlap 7/13 = 0.54, right at 0.5 and wrong from 0.55 on."""
    result = score([candidates((0, 0.9, 3, 0))], [truth((0, 0, 0))], 1)
    assert result.map50 == 1.0
    assert result.map == pytest.approx(0.1)
    assert result.centre_median_px == pytest.approx(3.0)


def test_the_wrong_name_counts_as_wrong_but_not_for_any_class() -> None:
    result = score([candidates((1, 0.9, 0, 0))], [truth((0, 0, 0))], 2)
    assert result.map50 == 0.0
    assert result.any50 == 1.0
    assert result.confusion[0, 1] == 1


def test_a_thing_that_is_found_twice_counts_once() -> None:
    result = score([candidates((0, 0.9, 0, 0), (0, 0.8, 1, 0))], [truth((0, 0, 0), (0, 50, 50))], 1)
    assert result.map50 == pytest.approx(51 / 101)
    assert result.confusion.tolist() == [[1, 1], [1, 0]]
