# SPDX-License-Identifier: Apache-2.0
"""docs/requirements.md against the tests: each requirement is checked by a test that carries its id as a marker."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

TESTS = Path(__file__).parent
PAGE = (TESTS.parent / "docs" / "requirements.md").read_text(encoding="utf-8")
REQUIREMENTS, _, PITFALLS = PAGE.partition("## Pitfalls")
#: Id to the text of the row and the mark after it.
ROWS = {
    id_: (text, mark.strip())
    for id_, text, mark in re.findall(r"^\| ([A-Z]-\d\d) \| (.*?) \|(.*)$", REQUIREMENTS, re.M)
}
PLANNED = {id_ for id_, (_, mark) in ROWS.items() if "planned" in mark}


@pytest.fixture(scope="module")
def tested() -> set[str]:
    """The requirement ids that tests carry as markers, without running any test."""
    marks = (
        re.findall(r"^[^#\n]*pytest\.mark\.requirement\(([^)]*)\)", path.read_text(encoding="utf-8"), re.M)
        for path in TESTS.rglob("test_*.py")
    )
    return set(re.findall(r'"([A-Z]-\d+)"', " ".join(mark for found in marks for mark in found)))


def test_the_page_lists_each_id_once_and_in_order() -> None:
    listed = re.findall(r"^\| ([A-Z]-\d\d) \|", REQUIREMENTS, re.M)
    last = {"A": 78, "B": 72, "P": 34, "N": 24, "R": 32, "M": 9}
    assert listed == [f"{area}-{n:02}" for area in last for n in range(1, last[area] + 1)]
    assert listed == list(ROWS)


def test_each_requirement_has_a_test(tested: set[str]) -> None:
    assert [f"{id_}: {text}" for id_, (text, _) in ROWS.items() if id_ not in tested | PLANNED] == []


def test_no_test_carries_an_unknown_id(tested: set[str]) -> None:
    assert tested - ROWS.keys() == set()


def test_what_is_planned_is_of_area_r_and_not_tested_yet(tested: set[str]) -> None:
    assert {id_[0] for id_ in PLANNED} <= {"R"}
    assert PLANNED & tested == set(), "these have tests: remove the mark `planned` in docs/requirements.md"


@pytest.mark.requirement("N-22")
def test_each_pitfall_has_a_regression_test(tested: set[str]) -> None:
    pitfalls = re.findall(r"^\| ([A-Z]-\d\d) \|", PITFALLS, re.M)
    assert len(pitfalls) >= 28
    assert set(pitfalls) - tested == set()
