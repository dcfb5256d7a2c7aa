# SPDX-License-Identifier: Apache-2.0
"""Log files of a run, whose writers never wait for the disk and never fail with it."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable, Sequence
from datetime import datetime
from pathlib import Path

from openarm_common.printable import LONGEST_LINE, printable


class LogFile:
    """Appends lines with the time of day; what the disk does not take is counted, and the file says how much it was.

    Args:
        path: Path of the file, which is made with the first line.
        fault: Is called with the reason when lines begin to be lost.
    """

    def __init__(self, path: Path, fault: Callable[[str], None]) -> None:
        self.path = path
        #: Lines that were lost in all.
        self.lost = 0
        self._fault = fault
        self._missing, self._reason = 0, ""

    def write(self, lines: Iterable[str]) -> None:
        """Append lines; as many as there is room for."""
        now = datetime.now().isoformat(sep=" ", timespec="milliseconds")
        shown = [printable(line, colours=True, longest=LONGEST_LINE) for text in lines for line in text.split("\n")]
        texts = [f"{now} {line}\n".encode(errors="replace") for line in shown]
        if self._missing:
            texts.insert(0, f"{now} {self._missing} lines are missing here: {self._reason}\n".encode())
        written = self._append(texts)
        if self._missing and written:
            texts, written, self._missing = texts[1:], written - 1, 0
        elif self._missing:
            texts = texts[1:]
        lost = len(texts) - written
        self.lost += lost
        self._missing, before = self._missing + lost, self._missing
        if lost and not before:
            self._fault(self._reason)

    def _append(self, texts: Sequence[bytes]) -> int:
        """Write whole lines, as many as there is room for; return how many."""
        data = b"".join(texts)
        try:
            with self.path.open("ab", buffering=0) as file:
                written = file.write(data)
                kept = data[:written].rfind(b"\n") + 1
                if kept < len(data):
                    file.truncate(file.tell() - written + kept)
                    self._reason = os.strerror(errno.ENOSPC)
        except OSError as error:
            self._reason = error.strerror or str(error)
            return 0
        return data.count(b"\n", 0, kept)
