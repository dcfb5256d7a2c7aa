# SPDX-License-Identifier: Apache-2.0
"""The published accuracy of hand-eye calibration: complete, and the stored solver is the best of its row."""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "calibration.md"


@pytest.mark.requirement("N-08")
def test_the_table_covers_cameras_poses_and_noise_and_the_refined_solution_is_the_best() -> None:
    text = PAGE.read_text(encoding="utf-8")
    (head,) = re.findall(r"^\| camera \| poses \| px \| robot \|(.*)\|$", text, re.MULTILINE)
    solvers = [name.strip() for name in head.split("|")]
    assert {"TSAI", "PARK", "HORAUD", "ANDREFF", "DANIILIDIS", "refined", "bound"} <= set(solvers)
    rows = re.findall(r"^\| (in hand|fixed) \| (\d+) \| ([\d.]+) \| (\S+) \|(.*)\|$", text, re.MULTILINE)
    robots = ("exact", "0.2mm/0.02deg")
    expected = set(itertools.product(("in hand", "fixed"), ("5", "10", "20", "30"), ("0.1", "0.3", "1"), robots))
    assert {row[:4] for row in rows} == expected
    for *conditions, cells in rows:
        errors = dict(zip(solvers, (float(cell.split("/")[0]) for cell in cells.split("|")), strict=True))
        bound = errors.pop("bound")
        assert errors["refined"] == min(errors.values()), conditions
        assert errors["refined"] <= 1.2 * bound + 0.01, conditions
