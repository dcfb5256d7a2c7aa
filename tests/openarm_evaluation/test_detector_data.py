# SPDX-License-Identifier: Apache-2.0
"""Pictures with labels of the suite's own world."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from openarm_common.errors import OpenArmError
from openarm_common.scene.scene import SHAPES
from openarm_evaluation.detector.data import DataConfig, make_data, write_sheet
from openarm_evaluation.detector.scene import RandomViews
from openarm_evaluation.detector.yolo_text import read_classes, read_labels

SIZE = DataConfig(train=3, select=2, report=2, seed=7)


def files(folder) -> dict[str, bytes]:
    kinds = (".jpg", ".txt")
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.suffix in kinds}


@pytest.mark.requirement("P-18", "B-68")
def test_sets_are_the_same_for_a_seed_share_nothing_and_go_on_after_a_stop(tmp_path) -> None:
    made = make_data(tmp_path / "a", SIZE)
    assert made == {"train": 3, "select": 2, "report": 2}
    first = files(tmp_path / "a")
    assert read_classes(tmp_path / "a") == SHAPES
    pictures = [data for name, data in first.items() if name.endswith(".jpg")]
    assert len(set(pictures)) == 7
    for name in first:
        if name.startswith("labels"):
            kinds, boxes = read_labels(first[name].decode(), 640, 480, len(SHAPES), name)
            assert len(kinds) == len(boxes)
    # a stop leaves the last picture without labels; what is whole is kept, the rest is made as it would have been
    (tmp_path / "a" / "labels" / "select" / "000001.txt").unlink()
    (tmp_path / "a" / "images" / "report" / "000000.jpg").unlink()
    assert make_data(tmp_path / "a", SIZE) == {"train": 0, "select": 1, "report": 1}
    assert files(tmp_path / "a") == first
    with pytest.raises(OpenArmError, match=r"holds pictures of seed 7 .*requested is seed 8"):
        make_data(tmp_path / "a", SIZE.model_copy(update={"seed": 8}))
    sheet = cv2.imread(str(write_sheet(tmp_path / "a", "train", columns=2)))
    assert sheet.shape == (480, 640, 3)


@pytest.mark.requirement("B-23")
def test_a_data_set_is_large_enough_by_default() -> None:
    config = DataConfig()
    assert config.train >= 1500
    assert min(config.select, config.report) >= 100


@pytest.mark.requirement("P-18")
def test_all_classes_are_drawn_and_some_pictures_are_empty() -> None:
    """Boxes lie in the picture, large enough to be seen; the same seed draws the same picture."""
    views = RandomViews()
    empty, kinds = 0, set()
    for seed in range(5000, 5040):
        picture = views.draw(np.random.default_rng(seed))
        again = views.draw(np.random.default_rng(seed)) if seed == 5000 else picture
        assert (again.rgb == picture.rgb).all()
        assert (again.boxes == picture.boxes).all()
        empty += not len(picture.boxes)
        kinds |= set(picture.classes.tolist())
        assert (picture.boxes[:, :2] >= 0).all()
        assert (picture.boxes[:, 2:] <= (640, 480)).all()
        assert (picture.boxes[:, 2:] - picture.boxes[:, :2] >= 6).all()
    views.close()
    assert 4 <= empty <= 14
    assert kinds == {0, 1, 2}
