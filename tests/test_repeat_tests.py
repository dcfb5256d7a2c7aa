# SPDX-License-Identifier: Apache-2.0
"""tools/repeat_tests.py: which tests belong to which part, and what a repetition reports."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tools"))

from repeat_tests import paths_of  # noqa: E402

#: Passes in the first run and fails in the second.
FLAKY = """
from pathlib import Path

def test_steady():
    pass

def test_flaky(request):
    marks = Path(request.config.rootpath, "runs")
    marks.mkdir(exist_ok=True)
    number = len(list(marks.iterdir())) + 1
    (marks / str(number)).touch()
    assert number != 2, "it was the second time"
"""


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A checkout with the tool and a few tests."""
    for name in ("test_top.py", "openarm_motion/test_a.py", "nodes/test_b.py", "graph/test_c.py", "native/test_d.py"):
        path = tmp_path / "tests" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text("def test_nothing():\n    pass\n")
    tool = tmp_path / "tools" / "repeat_tests.py"
    tool.parent.mkdir()
    tool.write_text((ROOT / "tools" / "repeat_tests.py").read_text(encoding="utf-8"), encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\naddopts = --import-mode=importlib\n")
    return tmp_path


def repeat(checkout: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    env = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_")}
    command = [
        sys.executable,
        "tools/repeat_tests.py",
        "--out",
        "logs",
        *arguments,
        "-n",
        "0",
        "-p",
        "no:cacheprovider",
    ]
    return subprocess.run(command, cwd=checkout, env=env, capture_output=True, text=True, timeout=120.0, check=False)


@pytest.mark.long
def test_a_test_that_fails_once_is_counted_and_named_with_its_error(checkout: Path) -> None:
    (checkout / "tests" / "nodes" / "test_b.py").write_text(FLAKY)
    done = repeat(checkout, "--times", "2", "--parts", "nodes")
    assert done.returncode == 1, done.stdout + done.stderr
    assert "nodes 1: passed" in done.stdout
    assert "nodes 2: 1 failed" in done.stdout
    assert "1 of 2  tests.nodes.test_b::test_flaky  (runs 2)" in done.stdout
    assert "it was the second time" in done.stdout
    assert "test_steady" not in done.stdout
    assert (checkout / "logs" / "nodes_2.log").is_file()


@pytest.mark.long
def test_every_test_belongs_to_a_part_and_success_is_zero(checkout: Path) -> None:
    parts = {name: [Path(path).name for path in paths] for name, paths in paths_of(checkout / "tests").items()}
    assert parts == {
        "core": ["openarm_motion", "test_top.py"],
        "nodes": ["nodes"],
        "graph": ["graph"],
        "other": ["native"],
    }
    done = repeat(checkout, "--times", "1", "--parts", "core", "--load")
    assert done.returncode == 0, done.stdout + done.stderr
    assert "core 1: passed" in done.stdout
    assert "2 passed" in (checkout / "logs" / "core_1.log").read_text()


def test_a_run_without_tests_and_a_wrong_call_do_not_pass(checkout: Path) -> None:
    (checkout / "tests" / "graph" / "test_c.py").write_text("import nothing_like_it\n")
    done = repeat(checkout, "--times", "1", "--parts", "graph", "-k", "no_such_test")
    assert done.returncode == 1
    assert repeat(checkout, "--parts", "everything").returncode == 2
    assert repeat(checkout, "--times", "0").returncode == 2
