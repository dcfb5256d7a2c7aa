# SPDX-License-Identifier: Apache-2.0
"""Configuration files: what is wrong is named, all at once."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import Field

from openarm_common.config import Config, load_config
from openarm_common.errors import Code, OpenArmError


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
    with pytest.raises(OpenArmError) as caught:
        _load(tmp_path, "rate: -1\nnmae: b")
    assert caught.value.code is Code.CONFIG_INVALID
    for part in ("example.yaml:rate", "greater than 0", "got -1", "example.yaml:nmae", "valid keys: rate, name"):
        assert part in caught.value.message


@pytest.mark.parametrize(("text", "part"), [("[1, 2]", "holds a list"), ("a: [", "not valid YAML")])
def test_what_is_no_mapping_is_refused(tmp_path: Path, text: str, part: str) -> None:
    with pytest.raises(OpenArmError, match=part):
        _load(tmp_path, text)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(OpenArmError, match="does not exist"):
        load_config(tmp_path / "none.yaml", _Example)
