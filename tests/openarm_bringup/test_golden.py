# SPDX-License-Identifier: Apache-2.0
"""The bag of the repository gives its golden numbers, twice the same; a number that is changed is noticed."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from openarm_bringup.bags import golden
from openarm_bringup.bags.bag import BagWriter, open_bag
from openarm_bringup.bags.ros.bag import numbers_of
from openarm_bringup.commands import record
from openarm_common.errors import Code, OpenArmError

BAG = Path(__file__).parents[1] / "data" / "demo_pick"


@pytest.mark.long
@pytest.mark.requirement("P-32")
def test_the_bag_of_the_repository_gives_its_golden_numbers_twice() -> None:
    """Perception and map in CI, from recorded topics, without GPU, display or graph."""
    assert sum(file.stat().st_size for file in BAG.iterdir()) < 5e6
    with open_bag(BAG) as bag:
        first, second = numbers_of(bag), numbers_of(bag)
    assert first == second
    assert not golden.compare(golden.read(BAG / "golden.json"), first)


@pytest.mark.long
@pytest.mark.requirement("P-32")
def test_the_bag_gives_its_golden_numbers_and_a_changed_one_fails_and_is_named(tmp_path: Path) -> None:
    path = tmp_path / "golden.json"
    shutil.copy(BAG / "golden.json", path)
    data = json.loads(path.read_text())
    data["numbers"]["detection/overhead/blue/x_mm"]["value"] += 1.0
    data["numbers"]["detection/overhead/pink/frames"] = {"value": 3, "tolerance": 0}
    path.write_text(json.dumps(data))
    outcome = record.check(BAG, golden=path)
    assert not outcome.success
    assert "2 of" in outcome.message
    assert "detection/overhead/blue/x_mm" in outcome.text
    assert "pink/frames: 3 expected, not there" in outcome.text


def test_update_writes_the_numbers_and_keeps_the_tolerances(tmp_path: Path) -> None:
    path = tmp_path / "golden.json"
    golden.write(path, {"a_mm": 1.0, "map/free": 1000.0, "n": 2}, {})
    entries = golden.read(path)
    assert [entries[name]["tolerance"] for name in ("a_mm", "map/free", "n")] == [0.5, 2.0, 0.0]
    entries["a_mm"]["tolerance"] = 3.0
    golden.write(path, {"a_mm": 2.0}, entries)
    assert golden.read(path) == {"a_mm": {"value": 2.0, "tolerance": 3.0}}
    assert not golden.compare(golden.read(path), {"a_mm": 4.9})
    assert [str(d) for d in golden.compare(golden.read(path), {"b": 1.0, "a_mm": float("nan")})] == [
        "a_mm: nan, expected 2 within 3",
        "b: 1, which no golden number expects",
    ]


@pytest.mark.parametrize("content", ["", "[]", '{"numbers": {"a": 1}}', '{"numbers": {"a": {"value": "x"}}}'])
def test_files_without_golden_numbers_are_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "golden.json"
    with pytest.raises(OpenArmError, match="--update writes them"):
        golden.read(path)
    path.write_text(content)
    with pytest.raises(OpenArmError, match=r"holds no golden numbers|is not valid JSON"):
        golden.read(path)


def test_a_bag_that_is_not_there_is_named_before_its_numbers(tmp_path: Path) -> None:
    with pytest.raises(OpenArmError, match=f"no bag at {tmp_path}/none"):
        record.check(tmp_path / "none")


def test_a_bag_without_frames_is_refused_by_name(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "bag", {}):
        pass
    with open_bag(tmp_path / "bag") as bag, pytest.raises(OpenArmError, match="topics: none") as refused:
        numbers_of(bag)
    assert refused.value.code == Code.NOTHING_DETECTED
