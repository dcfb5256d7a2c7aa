# SPDX-License-Identifier: Apache-2.0
"""Where tests run in two processes, one that is marked `alone` has the machine for itself (conftest.py)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: Each test writes when it was at work, s.
FILE = """
import json, pathlib, threading, time
import pytest

{mark}
@pytest.mark.parametrize("k", range(3))
def test_of_some_time(k):
    began = time.monotonic()
    threading.Event().wait(0.2)
    path = pathlib.Path(__file__)
    path.with_name(f"{{path.stem}}_{{k}}.json").write_text(json.dumps([began, time.monotonic()]))
"""


@pytest.mark.long
def test_a_test_marked_alone_runs_alone_and_the_others_run_in_parallel(tmp_path: Path) -> None:
    """Also between two tests of a file, whose module fixtures are in place then, too."""
    marks = {"a": "", "b": "", "c": "", "d": "@pytest.mark.alone", "e": "@pytest.mark.alone"}
    for name, mark in marks.items():
        (tmp_path / f"test_{name}.py").write_text(FILE.format(mark=mark))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "xdist", "-p", "tests.conftest"]
    command += ["-n", "2", "--dist", "loadfile"]
    env = {
        **os.environ,
        "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1",
        "PYTHONPATH": os.pathsep.join([str(ROOT), *filter(None, sys.path)]),
    }
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=60.0, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    spans = {path.stem: json.loads(path.read_text()) for path in tmp_path.glob("test_*.json")}
    assert len(spans) == 3 * len(marks)

    def overlapping(name: str, began: float, ended: float) -> set[str]:
        return {other for other, (a, b) in spans.items() if not other.startswith(name) and a < ended and b > began}

    for name in ("test_d", "test_e"):
        times = [time for stem, span in spans.items() if stem.startswith(name) for time in span]
        assert overlapping(name, min(times), max(times)) == set()
    assert any(overlapping(stem[:6], *spans[stem]) for stem in spans)
