# SPDX-License-Identifier: Apache-2.0
"""Memory, descriptors and threads of processes over time, as CSV and as a figure."""

from __future__ import annotations

import csv
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import astuple, dataclass, fields
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np
import psutil

from openarm_common.figures import render_figure, sheet

_EVERY_S = 5.0
_MIB = 2**20


@dataclass(frozen=True)
class Use:
    """What a node and its children use at one time: s since the start, MiB, numbers."""

    seconds: float
    node: str
    rss: float
    pss: float
    descriptors: int
    threads: int


def use_of(node: str, pid: int, seconds: float) -> Use:
    """Measure a process with its children.

    Raises:
        psutil.Error: It has ended.
    """
    rss = pss = descriptors = threads = 0
    for process in (psutil.Process(pid), *psutil.Process(pid).children(recursive=True)):
        memory = process.memory_full_info()
        rss, pss = rss + memory.rss, pss + memory.pss
        descriptors, threads = descriptors + process.num_fds(), threads + process.num_threads()
    return Use(round(seconds, 1), node, round(rss / _MIB, 1), round(pss / _MIB, 1), descriptors, threads)


class Usage:
    """Measures nodes once per 5 s in a thread, into a CSV file; a context manager."""

    def __init__(self, pids: Callable[[], Mapping[str, int]], path: Path) -> None:
        self.uses: list[Use] = []
        self._pids, self._path, self._end = pids, path, threading.Event()
        self._thread = threading.Thread(target=self._run, name="usage", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end.set()
        self._thread.join(timeout=_EVERY_S)

    def _run(self) -> None:
        began = time.monotonic()
        with self._path.open("w", newline="", encoding="utf-8") as file:
            table = csv.writer(file)
            table.writerow(field.name for field in fields(Use))
            while not self._end.wait(_EVERY_S):
                for node, pid in self._pids().items():
                    try:
                        use = use_of(node, pid, time.monotonic() - began)
                    except psutil.Error:  # it was killed meanwhile
                        continue
                    self.uses.append(use)
                    table.writerow(astuple(use))
                file.flush()


def growth(uses: list[Use]) -> dict[str, float]:
    """Return by how much the memory of each node grows in the second half, MiB an hour, by a fitted line."""
    rates: dict[str, float] = {}
    middle = max((use.seconds for use in uses), default=0.0) / 2.0
    for node in dict.fromkeys(use.node for use in uses):
        late = [(use.seconds, use.rss) for use in uses if use.node == node and use.seconds > middle]
        if len(late) > 2:
            t, memory = np.array(late).T
            rates[node] = round(float(np.polyfit(t, memory, 1)[0]) * 3600.0, 1)
    return rates


def draw(uses: list[Use], path: Path) -> None:
    """Draw memory, descriptors and threads of each node over time as a PNG."""
    page = sheet(8.0 * 72.0, 7.0 * 72.0)
    figure = page.get_figure(root=True)
    assert figure is not None
    page.remove()
    for axes, (name, label) in zip(
        figure.subplots(3, 1, sharex=True),
        (("rss", "memory (RSS), MiB"), ("descriptors", "descriptors"), ("threads", "threads")),
        strict=True,
    ):
        for node in dict.fromkeys(use.node for use in uses):
            own = [use for use in uses if use.node == node]
            axes.plot([use.seconds / 60.0 for use in own], [getattr(use, name) for use in own], label=node, lw=1.0)
        axes.set_ylabel(label)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
    figure.axes[-1].set_xlabel("min")
    figure.subplots_adjust(top=0.87, bottom=0.07, left=0.09, right=0.98)
    names, labels = figure.axes[0].get_legend_handles_labels()
    figure.legend(names, labels, loc="upper center", ncols=4, fontsize=7, frameon=False)  # above the curves
    path.write_bytes(render_figure(figure.axes[0], "png", dpi=90.0))
