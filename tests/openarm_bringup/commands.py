# SPDX-License-Identifier: Apache-2.0
"""Commands run in this process, and what a supervisor leaves for them."""

from __future__ import annotations

import json
from typing import Any

import psutil
import pytest

from openarm_bringup import cli
from openarm_bringup.supervision.runs import NodeRecord, RunRecord


def calibrate(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, str, str]:
    """Exit code and output of `openarm calibrate`."""
    code = cli.run(["calibrate", *argv])
    out, err = capsys.readouterr()
    return code, out, err


def calibrate_fails(capsys: pytest.CaptureFixture[str], code: int, words: str, *argv: str) -> None:
    """Run `openarm calibrate`, which must end with a code, and with a sentence that has some words."""
    got, out, err = calibrate(capsys, *argv)
    assert got == code, err
    assert words in err
    assert "Traceback" not in out + err


def answer_of(capsys: pytest.CaptureFixture[str], *argv: str) -> tuple[int, dict[str, Any]]:
    """Exit code and JSON of a command."""
    code = cli.run([*argv, "--json"])
    return code, json.loads(capsys.readouterr().out)


def record_of(graph: str, domain: int, nodes: dict[str, NodeRecord] | None = None, **more: object) -> RunRecord:
    """What a supervisor says of its graph: this process, if nothing else is said."""
    me = psutil.Process()
    fields = {"pid": me.pid, "pid_created": me.create_time(), "discovery": "localhost", "run_dir": "", "started": ""}
    return RunRecord(graph=graph, domain=domain, nodes=nodes or {}, **(fields | more))  # type: ignore[arg-type]
