# SPDX-License-Identifier: Apache-2.0
"""A short run of `openarm chaos`."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.alone
@pytest.mark.requirement("P-34")
def test_a_graph_under_faults_holds_what_must_never_happen(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "openarm_bringup.cli", "chaos", "--json", "--seed", "1", "--rounds", "2"]
    command += ["--faults", "services", "--faults", "camera", "--out", str(tmp_path), "--minutes", "2"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
    done = subprocess.run(command, cwd=ROOT, env=env, capture_output=True, text=True, timeout=300, check=False)
    report = json.loads(done.stdout)
    assert report["violations"] == []
    assert done.returncode == 0, done.stderr
    assert report["faults"] == {"camera": 1, "services": 1}
    assert (report["requests"], (tmp_path / "usage.csv").exists()) == (2, True)
    rows = json.loads((tmp_path / "chaos.json").read_text())["rounds"]
    assert all(row["code"] != "INTERNAL" for row in rows)
