# SPDX-License-Identifier: Apache-2.0
"""What set-up prepares, so that nodes start fast."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest

from openarm_bringup import byte_code


def test_byte_code_is_kept_also_where_the_environment_keeps_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in many containers: a node of the graph then compiled up to 1,000 modules at each of its starts."""
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    module = tmp_path / "module.py"
    module.write_text("VALUE = 1\n")
    monkeypatch.setattr(byte_code, "imported_by_nodes", lambda: [module])
    byte_code.keep_byte_code()
    assert Path(importlib.util.cache_from_source(str(module))).is_file()
