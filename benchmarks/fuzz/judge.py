# SPDX-License-Identifier: Apache-2.0
"""What becomes of inputs: accepted, refused in a sentence, or a defect; with time and memory."""

from __future__ import annotations

import signal
import time
import traceback
from collections import Counter
from collections.abc import Callable
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from openarm_common.errors import OpenArmError

#: An input that takes longer hangs, s.
BOUND_S = 20.0
#: An input that needs more memory is a defect, MiB: twice what a recording may unpack to at a time.
BOUND_MIB = 512.0
#: Longest text of a refusal, characters.
LONGEST = 4000


@dataclass
class Tally:
    """What became of the inputs of a kind."""

    kind: str
    inputs: int = 0
    accepted: int = 0
    refused: int = 0
    hangs: int = 0
    worst_s: float = 0.0
    worst_mib: float = 0.0
    #: Where raw errors came from, and how often.
    raw: Counter[str] = field(default_factory=Counter[str])
    notes: list[str] = field(default_factory=list[str])

    @property
    def sound(self) -> bool:
        """Whether every input was accepted or refused, within bounds of time and memory."""
        return not self.raw and not self.hangs and self.worst_mib <= BOUND_MIB

    def take(self, work: Callable[[], object], *, bounded: bool = True) -> None:
        """Do the work of one input, and count how it ended.

        Args:
            work: Accepts the input by ending, and refuses it by an OpenArmError.
            bounded: Whether to end it after `BOUND_S`, and to measure its memory.
        """
        self.inputs += 1
        before, began = reset_peak() if bounded else 0.0, time.monotonic()
        try:
            with _alarm() if bounded else nullcontext():
                work()
            self.accepted += 1
        except OpenArmError as error:
            self.refused += 1
            if len(str(error)) > LONGEST or "\n" in str(error).rstrip():
                self.raw[f"a refusal of {len(str(error))} characters: {str(error)[:300]!r}"] += 1
        except _Hang:
            self.hangs += 1
        # Anything else is what this looks for.
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            self.raw[where(error)] += 1
        self.worst_s = max(self.worst_s, time.monotonic() - began)
        if bounded:
            self.worst_mib = max(self.worst_mib, peak_mib() - before)


def where(error: BaseException) -> str:
    """Return type, text and the last places in the suite of an error."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [f"{Path(f.filename).name}:{f.lineno}" for f in frames if "openarm_" in f.filename] or [
        f"{Path(f.filename).name}:{f.lineno}" for f in frames[-2:]
    ]
    return f"{type(error).__name__}: {str(error)[:120]!r} at {' < '.join(own[::-1][:4])}"


class _Hang(BaseException):
    """The bound is over."""


@contextmanager
def _alarm():
    def stop(*_: object) -> None:
        raise _Hang

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, BOUND_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def reset_peak() -> float:
    """Let the kernel measure the peak of memory again from now on; return what is in use, MiB."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return peak_mib()
    return peak_mib()


def peak_mib() -> float:
    """Return the largest amount of memory of this process since it was reset, MiB."""
    text = Path("/proc/self/status").read_text()
    return int(text.partition("VmHWM:")[2].split()[0]) / 1024
