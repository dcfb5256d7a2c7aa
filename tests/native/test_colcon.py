# SPDX-License-Identifier: Apache-2.0
"""The whole tree as a colcon workspace."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_colcon_builds_the_tree_and_what_it_installs_runs(tmp_path: Path) -> None:
    command = [str(ROOT / "tools" / "colcon_check.sh"), str(tmp_path)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=3500, check=False)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert "packages, models and config come from" in done.stdout
    assert done.stdout.count("a joint state of 16 joints") == 2


def test_colcon_check_in_a_fresh_clone_says_what_to_run_first(tmp_path: Path) -> None:
    script = tmp_path / "clone" / "tools" / "colcon_check.sh"
    script.parent.mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "colcon_check.sh", script)
    done = subprocess.run([str(script), str(tmp_path / "out")], capture_output=True, text=True, timeout=30, check=False)
    assert done.returncode == 2, done.stdout + done.stderr
    assert f"no {tmp_path}/clone/.venv/bin/python; run ./openarm doctor once" in done.stderr
    assert not (tmp_path / "out").exists()
