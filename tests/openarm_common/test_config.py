# SPDX-License-Identifier: Apache-2.0
"""Configuration files: what is wrong is named, all at once."""

from __future__ import annotations

import contextlib
import itertools
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import Field

from openarm_common.config import MAX_YAML_BYTES, Config, load_config, load_yaml, parse_yaml
from openarm_common.errors import Code, OpenArmError
from tests.refusals import refused, refuses


class _Example(Config):
    rate: float = Field(30.0, gt=0.0)
    name: str = "a"


def _load(tmp_path: Path, text: str) -> _Example:
    path = tmp_path / "example.yaml"
    path.write_text(text)
    return load_config(path, _Example)


def test_defaults_and_values(tmp_path: Path) -> None:
    assert _load(tmp_path, "") == _Example()
    assert _load(tmp_path, "rate: 5").rate == 5.0


def test_every_fault_is_named_with_file_key_and_value(tmp_path: Path) -> None:
    with refuses(Code.CONFIG_INVALID) as caught:
        _load(tmp_path, "rate: -1\nnmae: b")
    for part in ("example.yaml:rate", "greater than 0", "got -1", "example.yaml:nmae", "valid keys: rate, name"):
        assert part in caught.value.message


@pytest.mark.parametrize(("text", "part"), [("[1, 2]", "holds a list"), ("a: [", "not valid YAML")])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str, part: str) -> None:
    refused(part, _load, tmp_path, text)


_LAUGHS = "a: &a [x, x]\n" + "".join(f"{k}: &{k} [*{p}, *{p}]\n" for p, k in itertools.pairwise("abcdefghijklmnop"))


@pytest.mark.parametrize(
    ("text", "part"),
    [
        pytest.param(_LAUGHS, "aliases are not accepted", id="nested aliases"),
        pytest.param("a: &a [*a]", "aliases are not accepted", id="an alias of itself"),
        pytest.param("a: " + 20_000 * "[", "deeper than 32", id="brackets"),
        pytest.param("a:\n" + "".join(" " * k + "- \n" for k in range(200)), "deeper than 32", id="blocks"),
        pytest.param("a: 2026-99-99", "month must be", id="a date"),
        pytest.param("a: " + 5000 * "9", "not valid YAML", id="a long number"),
        pytest.param("rate: 1\nrate: 2", "'rate' is given twice", id="a key given twice"),
        pytest.param("{[1]: 2}", r"\[1\] is no key", id="a key that is a list"),
        pytest.param("1: 2", "has the key 1, expected names", id="a key that is a number"),
        pytest.param("a: !!python/object/apply:os.getcwd []", "could not determine a constructor", id="an object"),
        pytest.param("a: \0", "not valid YAML", id="a control character"),
        pytest.param("#" + "x" * MAX_YAML_BYTES, "longer than 4 MiB", id="long"),
    ],
)
def test_hostile_yaml_is_refused_in_a_sentence(tmp_path: Path, text: str, part: str) -> None:
    with refuses(Code.CONFIG_INVALID, part) as caught:
        _load(tmp_path, text)
    assert len(caught.value.message) < 500


@given(st.text(alphabet=[*"{}[]:,-&*!|>'\"#%@` \n\tab019.~?<_\x00\xff"], max_size=120))
def test_any_text_is_yaml_or_refused(text: str) -> None:
    with contextlib.suppress(OpenArmError):
        parse_yaml(text, "text")


def test_a_value_that_does_not_fit_is_quoted_in_brief(tmp_path: Path) -> None:
    error = refused(None, _load, tmp_path, f"rate: {'x' * 10_000}\nname: 0x{'f' * 10_000}")
    assert len(error.message) < 500


def test_what_is_no_file_of_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "latin.yaml").write_bytes(b"a: \xff")
    for path, part in (
        (tmp_path, "can't read"),
        (tmp_path / "latin.yaml", "is no text in UTF-8: byte 3 is 0xff"),
        (Path("/dev/zero"), "longer than"),
    ):
        refused(part, load_yaml, path)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    refused("does not exist", load_config, tmp_path / "none.yaml", _Example)
