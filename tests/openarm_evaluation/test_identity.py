# SPDX-License-Identifier: Apache-2.0
"""IDF1, switches, merged and split sights, on sequences with known answers."""

from __future__ import annotations

import numpy as np
import pytest

from openarm_evaluation.judging.identity import IdentityScore

NAN = np.nan


def scored(*frames: tuple[list[int], list[int], list[list[float]]]) -> IdentityScore[int]:
    score = IdentityScore[int]()
    for objects, ids, distance in frames:
        score.add(objects, ids, np.array(distance).reshape(len(objects), len(ids)))
    score.close()
    return score


def test_the_example_of_py_motmetrics_has_the_values_of_its_documentation() -> None:
    """Its README: IDF1 83.3 % and one switch over three frames; 75.0 % and none over the first two."""
    frames = (
        ([1, 2], [1, 2, 3], [[0.1, NAN, 0.3], [0.5, 0.2, 0.3]]),
        ([1, 2], [1], [[0.2], [0.4]]),
        ([1, 2], [1, 3], [[0.6, 0.2], [0.1, 0.6]]),
    )
    whole, part = scored(*frames), scored(*frames[:2])
    assert (whole.idf1, whole.switches) == (pytest.approx(5.0 / 6.0), 1)
    assert (part.idf1, part.switches) == (pytest.approx(0.75), 0)


def test_ids_that_change_or_are_exchanged_cost_what_they_should() -> None:
    same = [[0.0, NAN], [NAN, 0.0]]
    assert scored(*[([1, 2], [1, 2], same)] * 4).idf1 == 1.0
    changed = scored(([1], [1], [[0.0]]), ([1], [1], [[0.0]]), ([1], [2], [[0.0]]), ([1], [2], [[0.0]]))
    assert (changed.idf1, changed.switches) == (0.5, 1)
    exchanged = scored(([1, 2], [1, 2], same), ([1, 2], [2, 1], same))
    assert (exchanged.idf1, exchanged.switches) == (0.5, 2)
    assert (scored().idf1, scored(([], [1], [])).idf1, scored(([1], [], [])).idf1) == (1.0, 0.0, 0.0)


def test_sequences_are_closed_each_on_its_own() -> None:
    score = IdentityScore[int]()
    for first in (1, 7):
        for _ in range(3):
            score.add([1], [first], np.zeros((1, 1)))
        score.close()
    assert (score.idf1, score.switches, score.sights, score.shown) == (1.0, 0, 6, 6)


def test_images_show_what_is_merged_and_what_is_split() -> None:
    truth = np.repeat([0, 1, 2], [10, 30, 20])
    score = IdentityScore[int]()
    score.add_image(truth, np.repeat([0, 5, 6], [10, 30, 20]), 5)  # right
    assert (score.merged, score.split) == (0, 0)
    score.add_image(truth, np.repeat([0, 5], [10, 50]), 5)  # the second is in the id of the first
    assert (score.merged, score.split) == (1, 0)
    score.add_image(truth, np.repeat([0, 5, 8, 6], [10, 20, 10, 20]), 5)  # the first is shown by two
    assert (score.merged, score.split) == (1, 1)
    score.close()
    assert (score.sights, score.shown, score.switches) == (6, 6, 0)
    assert score.idf1 == pytest.approx(2 * (3 + 2) / 12)  # 30 of 50 pixels and 20 of 30 are overlap enough
