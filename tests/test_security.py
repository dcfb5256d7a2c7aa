# SPDX-License-Identifier: Apache-2.0
"""SECURITY.md against the tests: each promise names tests that exist."""

from __future__ import annotations

import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TEXT = (ROOT / "SECURITY.md").read_text(encoding="utf-8")


def test_each_promise_names_tests_that_exist() -> None:
    rows = re.findall(r"^\| (.+?) \| (.+) \|$", TEXT.partition("## Promises")[2], re.MULTILINE)[1:]
    assert len(rows) >= 19
    for promise, tests in rows:
        named = re.findall(r"`(tests/[\w/]+\.py)::(test_\w+)`", tests)
        assert named, promise
        assert len(named) == tests.count("`") // 2, promise
        for path, test in named:
            text = (ROOT / path).read_text(encoding="utf-8")
            assert re.search(rf"^(async )?def {test}\(", text, re.MULTILINE), f"{path}::{test}"
