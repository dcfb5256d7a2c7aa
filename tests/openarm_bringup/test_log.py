# SPDX-License-Identifier: Apache-2.0
"""Log files on a disk that takes nothing, and takes again."""

from __future__ import annotations

import asyncio
import os
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from openarm_bringup.supervision.log import LogFile
from openarm_bringup.supervision.process import NodeProcess, command


def texts(path: Path) -> list[str]:
    """The lines of a log without the time of day."""
    content = path.read_text()
    assert content.endswith("\n")
    return [line.split(" ", 2)[2] for line in content.splitlines()]


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file grows beyond a size: a write is cut there, as on a disk that becomes full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


def test_lines_that_the_disk_does_not_take_are_counted_and_the_file_says_how_many(tmp_path: Path) -> None:
    path, said = tmp_path / "node.log", list[str]()
    log = LogFile(path, said.append)
    path.symlink_to("/dev/full")
    log.write(["one", "two"])
    log.write(["three"])
    assert (log.lost, said) == (3, ["No space left on device"])
    path.unlink()
    log.write(["four"])
    log.write(["five"])
    assert texts(path) == ["3 lines are missing here: No space left on device", "four", "five"]
    assert (log.lost, len(said)) == (3, 1)


def test_a_disk_that_becomes_full_within_a_write_keeps_whole_lines(tmp_path: Path) -> None:
    path, said = tmp_path / "node.log", list[str]()
    log = LogFile(path, said.append)
    log.write(["first"])
    size = path.stat().st_size
    with largest_file(2 * size + 10):
        log.write(["again", "cut", "lost"])
        assert texts(path) == ["first", "again"]
        log.write(["also"])
    assert (log.lost, len(said)) == (3, 1)
    log.write([])
    assert texts(path)[2].startswith("3 lines are missing here: ")


def test_a_folder_that_has_gone_is_a_fault_like_a_full_disk(tmp_path: Path) -> None:
    said: list[str] = []
    log = LogFile(tmp_path / "gone" / "node.log", said.append)
    log.write(["of two\nlines"])
    assert (log.lost, said) == (2, ["No such file or directory"])


def test_a_process_that_says_nothing_has_a_log(tmp_path: Path) -> None:
    async def run() -> int:
        process = await NodeProcess.start(command(["true"], os.environ), LogFile(tmp_path / "node.log", str))
        return await process.wait()

    assert asyncio.run(run()) == 0
    assert (tmp_path / "node.log").read_bytes() == b""
