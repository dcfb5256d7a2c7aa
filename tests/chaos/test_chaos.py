# SPDX-License-Identifier: Apache-2.0
"""A short run of `openarm chaos`."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]


@pytest.mark.long
@pytest.mark.alone
@pytest.mark.requirement("P-34")
def test_a_graph_under_faults_holds_what_must_never_happen(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "openarm_bringup.cli", "chaos", "--json", "--seed", "1", "--rounds", "2"]
    command += ["--faults", "services", "--faults", "camera", "--out", str(tmp_path), "--minutes", "2"]
    env = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path), "PYTHONFAULTHANDLER": "1"}
    report, code = _finished(command, env, tmp_path, 240.0)
    assert report["violations"] == []
    assert code == 0, report
    assert report["faults"] == {"camera": 1, "services": 1}
    assert (report["requests"], (tmp_path / "usage.csv").exists()) == (2, True)
    rows = json.loads((tmp_path / "chaos.json").read_text())["rounds"]
    assert all(row["code"] != "INTERNAL" for row in rows)


def _finished(command: list[str], env: dict[str, str], folder: Path, seconds: float) -> tuple[dict[str, Any], int]:
    """Run a command to its end; where it never ends, fail with the stacks of its threads and the ends of all logs."""
    out, err = folder / "stdout", folder / "stderr"
    with out.open("wb") as stdout, err.open("wb") as stderr:
        process = subprocess.Popen(command, cwd=ROOT, env=env, stdout=stdout, stderr=stderr)
        try:
            code = process.wait(seconds)
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGABRT)
            process.wait(10.0)
            logs = [out, err, *sorted((folder / "run" / "logs").glob("*.log"))]
            ends = [f"== {log.name}\n{log.read_text(errors='replace')[-6000:]}" for log in logs]
            pytest.fail("\n".join([f"no end within {seconds:g} s", *ends]))
        finally:
            process.kill()
    return json.loads(out.read_text()), code
