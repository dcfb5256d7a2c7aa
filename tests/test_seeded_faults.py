# SPDX-License-Identifier: Apache-2.0
"""tools/seeded_faults.py: the faults of the list fit the code, and what tests notice is caught."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest
from seeded_faults import Fault, load, report, try_fault

ROOT = Path(__file__).resolve().parents[1]
FAULTS = load()


def test_there_are_faults_enough_of_every_package() -> None:
    packages = {path.parent.name for path in ROOT.glob("openarm_*/__init__.py")}
    counts = Counter(fault.package for fault in FAULTS)
    assert counts.keys() == packages
    assert min(counts.values()) >= 5
    assert counts.total() >= 60
    assert len({fault.id for fault in FAULTS}) == len(FAULTS)


@pytest.mark.parametrize("fault", FAULTS, ids=[fault.id for fault in FAULTS])
def test_a_fault_applies_and_its_tests_exist(fault: Fault) -> None:
    assert fault.file.startswith(f"{fault.package}/")
    assert fault.old != fault.new
    assert "\n" not in fault.old + fault.new
    assert fault.applies(ROOT)
    assert all((ROOT / test).exists() for test in fault.tests)


@pytest.mark.long
def test_what_tests_notice_is_caught_but_not_by_a_test_that_fails_anyway(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTEST_DISABLE_PLUGIN_AUTOLOAD", "1")
    (tmp_path / "half.py").write_text("def half(x: float) -> float:\n    return x / 2.0 + 0.0\n")
    (tmp_path / "test_half.py").write_text(
        "from half import half\n"
        "def test_wrong():\n    assert half(1.0) == 2.0\n"
        "def test_right():\n    assert half(4.0) == 2.0\n"
    )
    faults = [
        Fault("half", name, "half.py", old, new, ("test_half.py",))
        for name, old, new in (("third", "/ 2.0", "/ 3.0"), ("same", "+ 0.0", "- 0.0"), ("absent", "* 2.0", "/ 2.0"))
    ]
    rows = [try_fault(fault, tmp_path, long=False) for fault in faults]
    assert [row.verdict for row in rows] == ["caught", "missed", "not run"]
    assert rows[0].test == "test_half.py::test_right"
    assert "half                   1 of 3 caught" in report(rows)
