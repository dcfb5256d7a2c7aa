# SPDX-License-Identifier: Apache-2.0
"""Scheduling of the bridge's process."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

from openarm_common.priority import use_fifo

PROBE = """
import os, subprocess, sys, threading
from openarm_common.priority import use_fifo
stop = threading.Event()
thread = threading.Thread(target=stop.wait); thread.start()
said = use_fifo(7)
fifo = all(os.sched_getscheduler(int(t)) & os.SCHED_FIFO for t in os.listdir("/proc/self/task"))
child = subprocess.run([sys.executable, "-c", "import os; print(os.sched_getscheduler(0))"], capture_output=True)
stop.set()
print(said, fifo, child.stdout.decode().strip(), sep="|")
"""


def test_every_thread_is_real_time_and_children_are_not_where_the_system_allows_it() -> None:
    """Elsewhere the answer says what to do about it; nothing fails."""
    out = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True).stdout.strip()
    said, fifo, child = out.split("|")
    assert child == str(os.SCHED_OTHER)
    assert (said == "SCHED_FIFO 7" and fifo == "True") or ("rtprio" in said and fifo == "False")


def test_a_user_without_the_right_sees_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refuse)
    said = use_fifo(50)
    assert said.startswith("SCHED_OTHER")
    assert "ulimit -r 50" in said


def test_priority_0_changes_nothing() -> None:
    before = os.sched_getscheduler(0)
    assert use_fifo(0) == "SCHED_OTHER"
    assert os.sched_getscheduler(0) == before
