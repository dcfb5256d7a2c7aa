# SPDX-License-Identifier: Apache-2.0
"""The YOLO text format: what is written is read, and wrong files are refused by line."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from openarm_common.errors import Code
from openarm_evaluation.detector.yolo_text import read_classes, read_labels, write_classes, write_labels
from tests.refusals import refused

boxes = st.lists(
    st.tuples(st.integers(0, 2), st.integers(0, 600), st.integers(0, 440), st.integers(1, 40), st.integers(1, 40)),
    max_size=8,
)


@given(boxes)
@pytest.mark.requirement("B-68")
def test_labels_come_back_as_they_were_written(items) -> None:
    kinds = np.array([item[0] for item in items], np.int64)
    there = np.array([[u, v, u + w, v + h] for _, u, v, w, h in items], np.float64).reshape(-1, 4)
    text = write_labels(kinds, there, 640, 480)
    for line in text.splitlines():
        words = line.split()
        assert len(words) == 5
        assert words[0].isdigit()
        assert all(0.0 <= float(word) <= 1.0 for word in words[1:])
    again, back = read_labels(text, 640, 480, 3, "here.txt")
    assert again.tolist() == kinds.tolist()
    assert back == pytest.approx(there, abs=1e-3)


@pytest.mark.requirement("B-68")
def test_a_line_as_cvat_and_labelimg_write_it() -> None:
    kinds, there = read_labels("2 0.500000 0.250000 0.100000 0.200000\n\n", 640, 480, 3, "here.txt")
    assert kinds.tolist() == [2]
    assert there[0] == pytest.approx([288.0, 72.0, 352.0, 168.0])


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("1 0.5 0.5 0.1", "here.txt:2: '1 0.5 0.5 0.1'; expected `class cx cy width height`"),
        ("cube 0.5 0.5 0.1 0.1", "expected `class cx cy width height`"),
        ("3 0.5 0.5 0.1 0.1", "class 3; expected a whole number 0 .. 2"),
        ("1 320 240 64 48", "expected shares"),
        ("1 0.5 0.5 0.0 0.1", "is empty"),
        ("1 0.97 0.5 0.1 0.1", "leaves the picture"),
    ],
)
@pytest.mark.requirement("B-65")
def test_label_errors_are_refused_with_file_and_line(line: str, words: str) -> None:
    error = refused(r"here\.txt:2", read_labels, f"0 0.5 0.5 0.1 0.1\n{line}\n", 640, 480, 3, "here.txt")
    assert words in error.message
    assert error.code is Code.INVALID_ARGUMENT


def test_classes_are_read_as_a_list_or_a_mapping(tmp_path) -> None:
    write_classes(tmp_path, ("box", "cylinder"), ("train", "select"))
    assert read_classes(tmp_path) == ("box", "cylinder")
    assert (tmp_path / "classes.txt").read_text() == "box\ncylinder\n"
    (tmp_path / "dataset.yaml").write_text("names: [a, b, c]\n")
    assert read_classes(tmp_path) == ("a", "b", "c")
    (tmp_path / "dataset.yaml").write_text("names: 3\n")
    refused("expected a list of names", read_classes, tmp_path)
