# SPDX-License-Identifier: Apache-2.0
"""Expansions of xacro that are kept."""

from __future__ import annotations

from pathlib import Path

import pytest
import xacro

from openarm_common.robot.xacro_files import description_text

_HEAD = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro">'


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


def _expansions(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the list that grows with each expansion by xacro."""
    done: list[str] = []
    process = xacro.process_file

    def counted(name: str, **options: object) -> object:
        done.append(name)
        return process(name, **options)

    monkeypatch.setattr(xacro, "process_file", counted)
    return done


def test_an_expansion_is_kept_until_a_file_that_it_read_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = _expansions(monkeypatch)
    source, part, numbers = tmp_path / "r.urdf.xacro", tmp_path / "part.xacro", tmp_path / "n.yaml"
    loaded = '<xacro:property name="n" value="${xacro.load_yaml(\'n.yaml\')}"/>'
    source.write_text(f'{_HEAD}<xacro:include filename="part.xacro"/>{loaded}<link name="l${{n.a}}"/></robot>')
    part.write_text(f'{_HEAD}<link name="old"/></robot>')
    numbers.write_text("a: 1\n")
    first = description_text(source)
    assert description_text(source) == first
    assert '"l1"' in first
    assert len(done) == 1
    part.write_text(f'{_HEAD}<link name="new"/></robot>')
    assert '"new"' in description_text(source)
    numbers.write_text("a: 2\n")
    assert '"l2"' in description_text(source)
    assert len(done) == 3


@pytest.mark.parametrize(
    "line", ['<link name="$(optenv LINK a)"/>', '<xacro:include filename="no_*.xacro"/><link name="a"/>']
)
def test_an_expansion_that_depends_on_more_than_its_files_is_not_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, line: str
) -> None:
    done = _expansions(monkeypatch)
    source = tmp_path / "r.urdf.xacro"
    source.write_text(f"{_HEAD}{line}</robot>")
    assert description_text(source) == description_text(source)
    assert len(done) == 2


@pytest.mark.parametrize("damage", [b"", b"[]", b'{"files": {"/none": "0"}}', b'{"files": 1}', b"\xff"])
def test_a_damaged_cache_costs_an_expansion(tmp_path: Path, damage: bytes) -> None:
    source = tmp_path / "r.urdf.xacro"
    source.write_text(f'{_HEAD}<link name="a"/></robot>')
    text = description_text(source)
    (kept,) = (tmp_path / "cache" / "openarm" / "xacro").iterdir()
    kept.write_bytes(damage)
    assert description_text(source) == text
