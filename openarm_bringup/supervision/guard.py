# SPDX-License-Identifier: Apache-2.0
"""Ends the nodes when their supervisor has been killed.

A process of its own, started as `python -I -S guard.py CLEAN...` with its standard input held by the supervisor,
which writes `+PGID` and `-PGID` lines for the process groups it starts and ends, and `bye` before it leaves. When the
input ends without `bye`, the supervisor is dead: the groups get INT, TERM and KILL, and CLEAN (a command) removes their
shared memory. Nothing outside the standard library, so that it starts in milliseconds and cannot fail with the rest.
"""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time

LADDER = ((signal.SIGINT, 5.0), (signal.SIGTERM, 5.0), (signal.SIGKILL, 1.0))


def group_alive(group: int) -> bool:
    """Tell whether a process of the group still runs (a zombie does not)."""
    for entry in os.listdir("/proc"):
        if not entry.isdigit():
            continue
        try:
            with open(f"/proc/{entry}/stat", encoding="utf-8", errors="replace") as stat:
                fields = stat.read().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[2]) == group and fields[0] not in "ZX":
            return True
    return False


def end(groups: set[int]) -> None:
    """Send the ladder of signals to every group until it is empty."""
    for number, grace in LADDER:
        for group in groups:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(group, number)
        deadline = time.monotonic() + grace
        while any(group_alive(group) for group in groups):
            if time.monotonic() > deadline:
                break
            time.sleep(0.05)
        groups = {group for group in groups if group_alive(group)}
        if not groups:
            return


def main() -> None:
    """Read the groups until the input ends; then end those that are left."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)  # a Ctrl-C at the terminal is for the supervisor
    groups: set[int] = set()
    for line in sys.stdin:
        text = line.strip()
        if text == "bye":
            return
        (groups.add if text[0] == "+" else groups.discard)(int(text[1:]))
    if groups:
        end(groups)
        if len(sys.argv) > 1:
            subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, timeout=20, check=False)


if __name__ == "__main__":
    main()
