# SPDX-License-Identifier: Apache-2.0
"""Paths that requests name: regular files of the right suffix, and nothing of others replaced."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from openarm_common import asked_files
from openarm_common.asked_files import file_to_read, file_to_write
from openarm_common.errors import Code, OpenArmError

MAPS = (".bt", ".ot")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "mine.bt").write_bytes(b"map")
    (tmp_path / "notes.txt").write_text("notes")
    (tmp_path / "link.bt").symlink_to("notes.txt")
    (tmp_path / "dangling.bt").symlink_to("nothing")
    (tmp_path / "folder.bt").mkdir()
    os.mkfifo(tmp_path / "pipe.bt")
    (tmp_path / "device.bt").symlink_to("/dev/zero")
    return tmp_path


def refusal(of: Callable[[str, tuple[str, ...]], Path], text: str) -> str:
    with pytest.raises(OpenArmError) as refused:
        of(text, MAPS)
    assert refused.value.code == Code.INVALID_ARGUMENT
    assert "expected" in refused.value.message
    assert refused.value.message.isprintable()
    assert len(refused.value.message) < 600
    return refused.value.message


@pytest.mark.parametrize("of", [file_to_read, file_to_write])
@pytest.mark.parametrize(
    "text",
    ["", "notes.txt", "/etc/passwd", "map", ".bt", "a\0b.bt", "a\nb.bt", "~nobody_of_this_name/a.bt", "a" * 9000],
)
def test_what_is_no_name_of_such_a_file_is_refused(of: Callable[[str, tuple[str, ...]], Path], text: str) -> None:
    refusal(of, text)


def test_a_name_longer_than_the_system_takes_is_refused(folder: Path) -> None:
    for of in (file_to_read, file_to_write):
        refusal(of, f"{folder}/{'a' * 5000}.bt")


def test_only_regular_files_are_read(folder: Path) -> None:
    assert file_to_read(f"{folder}/mine.bt", MAPS) == folder / "mine.bt"
    for name in ("none.bt", "folder.bt", "pipe.bt", "device.bt", "dangling.bt"):
        refusal(file_to_read, f"{folder}/{name}")


def test_a_new_file_or_one_of_this_user_is_written_and_nothing_else(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("new.ot", "mine.bt"):
        assert file_to_write(f"{folder}/{name}", MAPS) == folder / name
    for name in ("link.bt", "dangling.bt", "folder.bt", "pipe.bt", "none/new.bt", "notes.txt/new.bt"):
        refusal(file_to_write, f"{folder}/{name}")
    monkeypatch.setattr(asked_files.os, "geteuid", lambda: os.getuid() + 1)
    assert "another user's" in refusal(file_to_write, f"{folder}/mine.bt")


def test_home_is_the_node_s(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    assert file_to_write("~/map.bt", MAPS) == tmp_path / "map.bt"
