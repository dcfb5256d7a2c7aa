# SPDX-License-Identifier: Apache-2.0
"""The boards in `models/boards`."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from openarm_calibration.board.board import CircleGrid
from openarm_calibration.board.board_files import write_board
from openarm_common.resources import models_dir


@pytest.mark.requirement("A-43")
def test_the_board_of_the_scenes_is_the_one_that_is_looked_for(tmp_path: Path) -> None:
    """What lies in models/boards is what `openarm calibrate board` writes today for the default board."""
    write_board(CircleGrid(), tmp_path / "circles_4x11.xml")
    folder = models_dir() / "boards"
    assert (folder / "circles_4x11.xml").read_text() == (tmp_path / "circles_4x11.xml").read_text()
    pictures = [cv2.imread(str(place / "circles_4x11.png")) for place in (folder, tmp_path)]
    np.testing.assert_array_equal(*pictures)
